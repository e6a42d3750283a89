"""Random command lines: each is accepted, or refused with one line on stderr and exit code 2; never a traceback or a hang."""

import contextlib
import io
import math
import signal
import tempfile
import typing
from dataclasses import fields
from pathlib import Path

import pytest
from conftest import flags
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import gpo_a2c
import gpo_ppo
import joint_baseline
import single_baseline

GPO, BASELINES = (gpo_ppo, gpo_a2c), (single_baseline, joint_baseline)
MODULES = (*GPO, *BASELINES)
RUNS = [(module, {}) for module in GPO] + [(module, {"algo": algo}) for module in BASELINES for algo in ("ppo", "a2c")]
# Pendulum, and enough steps for any small plan; given first, so that what is drawn after it wins.
BASE = {"env_id": "Pendulum-v1", "total_timesteps": 10**6, "num_envs": 1, "num_steps": 16, "workers": 1}
# The same examples in each run of the tests; other tests' threads and a busy machine make times meaningless to Hypothesis.
FIXED = {"derandomize": True, "database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}


class Hang(BaseException):
    """Not an Exception, so that no handler takes it for bad input."""


@contextlib.contextmanager
def within(seconds):
    def late(*_):
        raise Hang(f"not through after {seconds} s")

    previous = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)


def outcome(function, words):
    """What function(words) returns, or the one line by which it refused."""
    said = io.StringIO()
    with within(120), contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            return function(words), None
        except SystemExit as stop:
            assert stop.code == 2, (words, stop.code, said.getvalue())
    line = said.getvalue()
    assert line.count("\n") == 1 and line.endswith("\n") and "error: " in line and len(line) < 2000, (words, line)
    return None, line


def table(module):
    """{flag: (type, bound or None)} of a script."""
    found = {}
    for flag in (flag for group in fields(module.Args) for flag in fields(group.type)):
        bound = getattr(flag.type, "__metadata__", (None,))[0]
        found[flag.name] = flag.type.__origin__ if bound else flag.type, bound
    return found


SWITCHED_OFF = {"track", "cuda", "resume"}  # these need a network, a device, a run; they have tests of their own
BUDGET = {"total_timesteps", "population", "workers", "num_envs", "num_steps", "expert_steps", "student_steps"}
BUDGET |= {"dagger_iterations"}  # each is right for itself, but not every plan fits into a budget
INSIDE = {
    ">= 10": st.integers(10, 10**4),
    "> 0": st.integers(1, 10**4),
    ">= 0": st.integers(0, 10**4),
    "> 0 or inf": st.sampled_from([1e-300, 0.5, 1, math.inf]),
    "in [0, 1]": st.floats(0, 1),
    "in [1, 100000]": st.integers(1, 10**5),
}
OUTSIDE = {
    ">= 10": st.integers(-(10**40), 9),
    "> 0": st.integers(-(10**40), 0),
    ">= 0": st.integers(-(10**40), -1),
    "> 0 or inf": st.sampled_from([0.0, -0.5, -math.inf, math.nan]),
    "in [0, 1]": st.sampled_from([-1e-300, 1.0000001, 1e308, math.inf, -math.inf, math.nan]),
    "in [1, 100000]": st.sampled_from([-1, 0, 100_001, 10**30]),
}
ODD = ["", " ", "nan", "inf", "-inf", "-1", "0", "1", "1.5", "1e308", "1e-400", str(10**30), "9" * 5000, "0x10", "1_0", "٣"]
ODD += ["None", "True", "--", "-", "--seed", "ü", "🦿", "\udc80", "a\nb", "'; rm", "%s{}", "..", "a/b", "~", "x" * 300]
ODD += ["/dev/null", "/no/such/folder", "{", "[]", "null", "{}", '{"g": NaN}', '{"g": 1e999}', '{"g": "ü"}', '{"": 1}', "[" * 9999]
ODD += ['{"g": {}}', '{"g": 1, "g": 2}', '{"max_episode_steps": 3}', '{"render_mode": "human"}', '{"num_envs": 2}']
ODD += ["CartPole-v1", "Pendulum", "Pendulum-v9", "rllab/Nothing-v0", "a/b/c-v0", "sys:Pendulum-v1", "HalfCheetah-v4"]
WORDS = st.one_of(st.sampled_from(ODD), st.text(max_size=8).filter(lambda text: "\0" not in text))  # no argv holds a NUL


@st.composite
def right_flags(draw):
    """A script, and right values for a few of its flags that change no budget."""
    module = draw(st.sampled_from(MODULES))
    known, words = table(module), []
    for name in draw(st.lists(st.sampled_from(sorted(known.keys() - SWITCHED_OFF - BUDGET)), max_size=6, unique=True)):
        kind, bound = known[name]
        if bound:
            words += flags(**{name: draw(INSIDE[bound])})
        elif typing.get_origin(kind) is typing.Literal:
            words += flags(**{name: draw(st.sampled_from(typing.get_args(kind)))})
        elif kind is bool:
            words += flags(**{name: draw(st.booleans())})
    return module, words


@st.composite
def one_wrong_flag(draw):
    """A script, right flags, and in their midst one number that is out of its bounds; the flag's name."""
    module, words = draw(right_flags())
    known = table(module)
    name = draw(st.sampled_from(sorted(name for name, (_, bound) in known.items() if bound)))
    value = draw(OUTSIDE[known[name][1]])
    wrong = [f"--{name.replace('_', '-')}", str(value)]
    return module, draw(st.sampled_from([words + wrong, wrong + words])) if wrong[0] not in words else wrong, wrong[0]


@st.composite
def anything(draw):
    """A script, and words that may be anything, most of them behind a flag that exists."""
    module = draw(st.sampled_from(MODULES))
    names = sorted(table(module).keys() - SWITCHED_OFF - {"run_dir"})
    words = []
    for _ in range(draw(st.integers(1, 4))):
        name = draw(st.sampled_from(names)).replace("_", "-")
        words += draw(st.one_of(WORDS.map(lambda word, name=name: [f"--{name}", word]), st.sampled_from([[f"--no-{name}"]])))
        words += draw(st.one_of(st.just([]), st.just([]), WORDS.map(lambda word: [word])))
    return module, words


def parse(module, words, **changes):
    with tempfile.TemporaryDirectory() as folder:
        return outcome(module.parse_args, [*flags(**{**BASE, "run_dir": folder, **changes}), *words])


def check_right_flags(case):
    module, words = case
    args, line = parse(module, words)
    assert line is None, (words, line)
    for flag, word in zip(words, words[1:]):
        if flag.startswith("--") and not word.startswith("--") and isinstance(getattr(args, flag[2:].replace("-", "_")), int):
            assert getattr(args, flag[2:].replace("-", "_")) == int(word)


def check_one_wrong_flag(case):
    module, words, name = case
    args, line = parse(module, words)
    assert args is None and name in line, (words, line)


def check_anything(case):
    module, words = case
    parse(module, words)


@settings(max_examples=15, **FIXED)
@given(right_flags())
def test_right_flags_are_accepted(case):
    check_right_flags(case)


@settings(max_examples=25, **FIXED)
@given(one_wrong_flag())
def test_one_number_out_of_bounds_is_refused_by_its_name(case):
    check_one_wrong_flag(case)


@settings(max_examples=40, **FIXED)
@given(anything())
@example((gpo_ppo, ["--rounds", str(10**30), "--total-timesteps", str(10**40)]))  # a plan that would fill the memory
@example((gpo_ppo, ["--env-kwargs", "[" * 10_000]))  # deeper than the parser's recursion
def test_any_words_are_accepted_or_refused_in_one_line(case):
    check_anything(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["right_flags", "one_wrong_flag", "anything"])
def test_many_more_of_each(name):
    checks = {"right_flags": check_right_flags, "one_wrong_flag": check_one_wrong_flag, "anything": check_anything}
    cases = {"right_flags": right_flags, "one_wrong_flag": one_wrong_flag, "anything": anything}
    settings(max_examples=1000, **FIXED)(given(cases[name]())(checks[name]))()


@pytest.mark.parametrize("where", ["/dev/null/runs", "/proc/no/such", "\udc80/../\udc80", "x" * 5000])
def test_a_folder_that_cannot_be_made_is_refused(where):
    with tempfile.TemporaryDirectory() as folder:
        at = where if where.startswith("/") else str(Path(folder) / where)
        args, line = outcome(gpo_ppo.parse_args, flags(**BASE, run_dir=at))
        assert "--run-dir" in line if line else Path(at).is_dir()


# ---------------------------------------------------------------- real runs

SMALL = {
    **dict(population=st.integers(1, 3), num_envs=st.integers(1, 3), num_steps=st.integers(1, 24)),
    **dict(max_episode_steps=st.integers(1, 24), total_timesteps=st.integers(1, 900), rounds=st.integers(1, 3)),
    **dict(segments=st.integers(1, 3), learning_rate=st.sampled_from([1e-8, 3e-3, 1.0]), kl_coef=st.sampled_from([1e-6, 1e4])),
    **dict(critic_learning_rate=st.sampled_from([1e-8, 1e-3]), gamma=st.sampled_from([0.0, 0.9, 1.0])),
    **dict(gae_lambda=st.sampled_from([0.0, 1.0]), critic_epochs=st.integers(1, 2), critic_minibatch_size=st.integers(1, 99)),
    **dict(update_epochs=st.integers(1, 3), kl_target=st.sampled_from([1e-12, 0.01, 1e6]), kl_hinge=st.sampled_from([0, 100])),
    **dict(kl_sharing_threshold=st.sampled_from([0.0, 0.5, 1e9]), importance_clip=st.sampled_from([1e-3, 1, math.inf])),
    **dict(diversity_weight=st.floats(0, 1), crossover_pool=st.sampled_from([1, 30, 8192]), critic_warmup=st.integers(0, 9)),
    **dict(crossover_top=st.sampled_from([0.0, 0.1, 1.0]), crossover_minibatch_size=st.integers(1, 99)),
    **dict(pi_s_epochs=st.just(1), expert_steps=st.integers(10, 40), student_steps=st.integers(1, 20)),
    **dict(dagger_iterations=st.integers(0, 2), dagger_epochs=st.just(1), comparison_episodes=st.integers(1, 2)),
    **dict(selection_episodes=st.integers(1, 2), report_episodes=st.integers(1, 2), seed=st.sampled_from([0, 10**30])),
    **dict(env_id=st.sampled_from(["Pendulum-v1", "gpo_test/Line-v0"]), vectorization=st.sampled_from(["auto", "sync"])),
}
# Where a default takes long, a run always gets the small one.
ALWAYS = {"num_envs", "num_steps", "max_episode_steps", "total_timesteps", "critic_epochs", "pi_s_epochs", "expert_steps"}
ALWAYS |= {"student_steps", "dagger_iterations", "dagger_epochs", "comparison_episodes", "selection_episodes"}
ALWAYS |= {"report_episodes", "population", "env_id"}


@st.composite
def small_runs(draw):
    """A script, and a command line of right values: a run of a second, or a budget that is too small for its plan."""
    module, values = draw(st.sampled_from(RUNS))
    known, values = table(module), dict(values)
    for name in sorted(known.keys() - SWITCHED_OFF):
        kind, bound = known[name]
        if name in SMALL and (name in ALWAYS or draw(st.booleans())):
            values[name] = draw(SMALL[name])
        elif typing.get_origin(kind) is typing.Literal and name not in values:
            values[name] = draw(st.sampled_from(typing.get_args(kind)))
        elif kind is bool:
            values[name] = draw(st.booleans())
    return module, {**values, "workers": 1, "run_name": "run"}


def check_small_run(case):
    module, values = case
    with tempfile.TemporaryDirectory() as folder:
        result, line = outcome(module.main, flags(**values, run_dir=folder))
        run = Path(folder) / "run"
        if line:
            assert "--total-timesteps" in line or "--population" in line, (values, line)
            assert not run.exists()
        else:
            assert math.isfinite(result["best"]) and 0 < result["global_step"] <= values["total_timesteps"]
            assert (run / "checkpoint.pt").exists() and (run / "policy.pt").exists()


@settings(max_examples=10, **FIXED)
@given(small_runs())
def test_small_runs_end_well_or_are_refused(case):
    check_small_run(case)


@pytest.mark.slow
def test_many_more_small_runs():
    settings(max_examples=150, **FIXED)(given(small_runs())(check_small_run))()
