"""Runs of gpo_ppo.py: what they leave behind, that their numbers depend on the flags alone, and what they refuse."""

import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import gpo_ppo

ROOT = Path(gpo_ppo.__file__).parent


def command_line(*argv, script=ROOT / "gpo_ppo.py", cwd=ROOT, **environ):
    """The script as a user runs it."""
    environ = {**os.environ, "COLUMNS": "200", **environ}
    return subprocess.run(
        [sys.executable, str(script), *argv], cwd=cwd, env=environ, capture_output=True, text=True, timeout=500
    )


def read_events(folder):
    """Scalars of all event files, tag -> list of (step, value), as TensorBoard shows them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    scalars = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    return scalars, events.Tags()["tensors"]


# ---------------------------------------------------------------- a run and what it leaves


def test_one_generation_through_the_command_line(tiny, tmp_path):
    done = command_line(*tiny("here", rounds=1), cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "here").iterdir()
    assert folder.name.startswith("Pendulum-v1__gpo_ppo__1__")
    kept = {path.name for path in folder.iterdir() if not path.name.startswith(("events.out", "."))}
    assert kept == {"args.json", "checkpoint.pt", "crossover_001.pt", "evaluation.json", "lineage.jsonl", "policy.pt"}
    assert "iterations [5]" in done.stdout and "1520 of 1600 steps" in done.stdout
    assert f"best {json.loads((folder / 'evaluation.json').read_text())['best']:.1f}" in done.stdout
    assert done.stderr == ""


def test_lineage_tells_where_every_child_comes_from(base_run):
    m, lines = 3, base_run.lineage
    assert [line["id"] for line in lines] == [3, 4, 5, 6, 7, 8]
    assert [(line["round"], line["slot"]) for line in lines] == [(r, s) for r in (1, 2) for s in range(m)]
    for line in lines:
        assert all(m * (line["round"] - 1) <= parent < m * line["round"] for parent in line["parents"])
        assert line["parents"][0] < line["parents"][1]
        numbers = ("parent_fitness", "parent_returns", "child_return", "kl_to_parents", "distillation_kl", "pi_s_accuracy")
        assert all(np.isfinite(line[name]).all() for name in numbers)
    for r in (1, 2):  # three couples of three members, fittest first
        here = [line for line in lines if line["round"] == r]
        assert len({tuple(line["parents"]) for line in here}) == 3
        fitness = [sum(line["parent_fitness"]) for line in here]
        assert fitness == sorted(fitness, reverse=True)
    assert base_run.checkpoint["population"]["ids"].tolist() == [6, 7, 8]


def test_evaluation_reports_the_winner_of_the_selection_episodes(base_run):
    evaluation = base_run.evaluation
    members = evaluation["members"]
    best = max(members, key=lambda member: member["selection_return"])
    assert [member["id"] for member in members] == [6, 7, 8]
    assert (evaluation["best"], evaluation["best_id"]) == (best["report_return"], best["id"])
    assert evaluation["best_std"] == best["report_std"] and evaluation["best_mean_action"] == best["mean_action_return"]
    assert members[evaluation["best_slot"]] == best
    assert evaluation["mean"] == pytest.approx(np.mean([member["report_return"] for member in members]))


def test_saved_policy_plays_its_reported_return(base_run, make_args):
    """policy.pt holds all that it takes: network, normalizer, flags, horizon."""
    saved = torch.load(base_run.folder / "policy.pt", weights_only=True)
    args = make_args(**saved["flags"])
    args.obs_dim, args.act_dim, args.max_episode_steps = saved["sizes"][0], saved["sizes"][-1], saved["max_episode_steps"]
    stats = gpo_ppo.SimpleNamespace(mean=saved["mean"].numpy()[None], inv_std=saved["inv_std"].numpy()[None])
    returns = gpo_ppo.evaluate(args, gpo_ppo.make_policy(saved["policy"][None], args), stats, "report", args.report_episodes)
    assert returns.mean() == pytest.approx(base_run.evaluation["best"], rel=1e-6)
    assert saved["id"] == base_run.evaluation["best_id"] and saved["report_return"] == base_run.evaluation["best"]
    assert stats.inv_std.min() > 0 and not np.allclose(stats.inv_std, 1)


def test_first_crossover_is_kept_with_parents_children_and_selectors(base_run, train, tmp_path):
    kept = torch.load(base_run.folder / "crossover_001.pt", weights_only=True)
    assert not (base_run.folder / "crossover_002.pt").exists()
    assert [list(couple) for couple in kept["couples"]] == [line["parents"] for line in base_run.lineage[:3]]
    assert kept["parents"].shape == kept["children"].shape == (3, base_run.checkpoint["population"]["policies"].shape[1])
    assert not torch.equal(kept["parents"], kept["children"]) and len(kept["pi_s"]) == 3
    run = train(tmp_path, save_crossovers=True, population=3, total_timesteps=2400)
    last = torch.load(run.folder / "crossover_002.pt", weights_only=True)
    assert torch.equal(last["children"], run.checkpoint["population"]["policies"])
    for name, value in torch.load(run.folder / "crossover_001.pt", weights_only=True).items():
        assert torch.equal(value, kept[name]) if torch.is_tensor(value) else name == "flags" or value == kept[name]


EVERY_ITERATION = """
    charts/SPS charts/learning_rate losses/approx_kl losses/entropy losses/explained_variance losses/kl_coef losses/policy_loss
    losses/value_loss sharing/size sharing/size_0 sharing/size_1 sharing/size_2 time/advantages time/critic_update
    time/policy_update time/rollout time/sharing time/statistics
    charts/episodic_length charts/episodic_return population/best_return population/mean_return population/min_return
    population/return_0 population/return_1 population/return_2 population/std_return""".split()
EVERY_ROUND = """
    crossover/child_minus_best_parent crossover/child_return crossover/distillation_kl crossover/expert_reward
    crossover/kl_to_parents crossover/parent_return crossover/pi_s_accuracy crossover/share_x crossover/student_reward
    population/diversity time/comparison time/crossover time/dagger time/pi_s time/select""".split()
AT_THE_END = ["eval/episodic_return", "eval/mean_return"]


def test_names_and_steps_of_all_scalars(base_run):
    scalars, texts = read_events(base_run.folder)
    assert set(scalars) == {*EVERY_ITERATION, *EVERY_ROUND, *AT_THE_END}
    assert "hyperparameters/text_summary" in texts
    iteration, crossover = 3 * 2 * 64, 3 * (100 + 20)
    steps, rounds, at = [], [], 0
    for _ in (1, 2):  # (2400 - 2 * 360) / 384 = 4.4, hence 4 iterations in 2 rounds
        for _ in (1, 2):
            at += iteration
            steps.append(at)
        at += crossover
        rounds.append(at)
    for names, expected in ((EVERY_ITERATION, steps), (EVERY_ROUND, rounds), (AT_THE_END, rounds[-1:])):
        for name in names:
            assert [step for step, _ in scalars[name]] == expected, name
    assert scalars["eval/episodic_return"][0][1] == pytest.approx(base_run.evaluation["best"], rel=1e-6)
    for r in (0, 1):
        lines = base_run.lineage[3 * r : 3 * r + 3]
        child = np.mean([line["child_return"] for line in lines])
        above = np.mean([line["child_return"] - max(line["parent_returns"]) for line in lines])
        assert scalars["crossover/child_return"][r][1] == pytest.approx(child, rel=1e-5)
        assert scalars["crossover/child_minus_best_parent"][r][1] == pytest.approx(above, rel=1e-4, abs=1e-4)


def test_flags_and_versions_are_recorded(base_run):
    names = {flag.name for group in fields(gpo_ppo.Args) for flag in fields(group.type)}
    assert set(base_run.args) == names | {"versions"}
    assert set(base_run.checkpoint["flags"]) == names
    assert base_run.args["versions"]["gymnasium"] == gym.__version__
    assert (base_run.args["population"], base_run.args["total_timesteps"]) == (3, 2400)


def other_values():
    """A valid value for each flag that is not its default."""
    words = {"env_id": "Pendulum-v1", "env_kwargs": '{"g": 9.0}', "workers": 3, "max_episode_steps": 77}
    words |= {
        "run_dir": None,
        "run_name": "other",
        "resume": None,
        "cuda": None,
    }  # set by the test, or with tests of their own
    for group in fields(gpo_ppo.Args):
        for flag in fields(group.type):
            if flag.name in words:
                continue
            default = getattr(group.type(), flag.name)
            if isinstance(default, bool):
                words[flag.name] = not default
            elif isinstance(default, int | float):
                words[flag.name] = default + 1 if isinstance(default, int) else default * 0.9
            else:
                choices = getattr(flag.type, "__args__", ())
                others = [choice for choice in choices if isinstance(choice, str) and choice != default]
                words[flag.name] = others[0] if others else "other"
    return {name: value for name, value in words.items() if value is not None}


def test_every_flag_reaches_the_run(tmp_path):
    values, argv = other_values(), ["--run-dir", str(tmp_path)]
    for name, value in values.items():
        flag = name.replace("_", "-")
        argv += [f"--{'' if value else 'no-'}{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    args = gpo_ppo.parse_args(argv)
    assert {name: args.flags[name] for name in values} == values
    assert {name: getattr(args, name) for name in values} == values
    defaults = {flag.name: getattr(group.type(), flag.name) for group in fields(gpo_ppo.Args) for flag in fields(group.type)}
    assert all(values[name] != defaults[name] for name in values)
    assert set(args.flags) - set(values) == {"run_dir", "resume", "cuda"}


def test_flags_may_be_written_with_underscores(tmp_path):
    args = gpo_ppo.parse_args(["--env_id", "Pendulum-v1", "--run_dir", str(tmp_path), "--num_steps", "7"])
    assert (args.env_id, args.num_steps) == ("Pendulum-v1", 7)


@pytest.mark.parametrize(
    "words, horizon",
    [
        (["--env-id", "Pendulum-v1"], 200),  # its own limit is lower
        (["--env-id", "HalfCheetah-v4"], 512),
        (["--env-id", "HalfCheetah-v4", "--max-episode-steps", "1000"], 1000),
    ],
)
def test_the_horizon(words, horizon, tmp_path):
    assert gpo_ppo.parse_args([*words, "--run-dir", str(tmp_path)]).max_episode_steps == horizon


# ---------------------------------------------------------------- budget


@pytest.fixture
def steps_taken(monkeypatch):
    """Counts what the environments themselves were asked to step: in training, and in evaluations."""
    taken, phase = {"training": 0, "evaluation": 0}, ["training"]
    step, evaluate = gym.vector.SyncVectorEnv.step, gpo_ppo.evaluate

    def counting_step(self, actions):
        taken[phase[0]] += self.num_envs
        return step(self, actions)

    def marked_evaluate(*args, **kwargs):
        phase[0] = "evaluation"
        try:
            return evaluate(*args, **kwargs)
        finally:
            phase[0] = "training"

    monkeypatch.setattr(gym.vector.SyncVectorEnv, "step", counting_step)
    monkeypatch.setattr(gpo_ppo, "evaluate", marked_evaluate)
    return taken


@pytest.mark.parametrize(
    "changes, expected",
    [
        ({"total_timesteps": 1600}, 4 * 256 + 2 * 240),
        ({"total_timesteps": 1503}, 3 * 256 + 2 * 240),
        ({"total_timesteps": 1600, "crossover": "copy"}, 6 * 256),
        ({"total_timesteps": 1000, "rounds": 9, "expert_steps": 19}, 3 * 256 + 3 * 2 * (10 + 20)),
    ],
)
def test_budget_counts_every_step_of_training_dagger_included(train, tmp_path, steps_taken, changes, expected):
    run = train(tmp_path, **changes)
    assert run.evaluation["global_step"] == steps_taken["training"] == expected
    assert run.evaluation["evaluation_steps"] == steps_taken["evaluation"]
    assert 0 <= changes["total_timesteps"] - expected < 256


def test_the_smallest_budget_that_an_error_names_is_enough(tiny, train, tmp_path, capfd):
    with pytest.raises(SystemExit):
        gpo_ppo.main(tiny(tmp_path / "no", total_timesteps=495))
    message = capfd.readouterr().err
    assert "496" in message
    assert train(tmp_path, total_timesteps=496).evaluation["global_step"] == 496


# ---------------------------------------------------------------- the numbers depend on the flags alone


def test_seeds_reproduce(base_run, train, assert_same_run, tmp_path):
    torch.manual_seed(123), np.random.seed(123)
    again = train(tmp_path / "a", population=3, total_timesteps=2400)
    assert_same_run(base_run, again)
    other = train(tmp_path / "b", population=3, total_timesteps=2400, seed=2)
    assert other.evaluation["members"] != base_run.evaluation["members"]


def test_two_workers_with_unequal_shares_give_the_numbers_of_one(base_run, train, assert_same_run, tmp_path):
    assert_same_run(base_run, train(tmp_path, population=3, total_timesteps=2400, workers=2))


WORKER_SETTINGS = {
    "Pendulum-v1": dict(total_timesteps=8 * 128 * 4 + 2 * 8 * 120),
    # 17 observations and 6 actions, batched stepping; 1280 samples a member, so that products take their blocked routes
    "HalfCheetah-v4": dict(total_timesteps=8 * 512 * 4 + 2 * 8 * 120, num_steps=256, max_episode_steps=100),
}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", WORKER_SETTINGS)
def test_any_number_of_workers_gives_the_same_numbers(env_id, train, assert_same_run, tmp_path):
    settings = dict(env_id=env_id, population=8, **WORKER_SETTINGS[env_id])
    one = train(tmp_path / "1", **settings, workers=1)
    for workers in (2, 3, 8):
        assert_same_run(one, train(tmp_path / str(workers), **settings, workers=workers))
    settings |= {"population": 2, "total_timesteps": settings["total_timesteps"] // 4}
    assert_same_run(train(tmp_path / "one", **settings, workers=1), train(tmp_path / "two", **settings, workers=2))


class Stop(Exception):
    pass


def stop_at(monkeypatch, call, before):
    """Makes the run end at the given call of save_checkpoint (the first is at the start), before or after it saves."""
    calls, save = [], gpo_ppo.save_checkpoint

    def save_or_stop(*args):
        calls.append(1)
        if len(calls) == call and before:
            raise Stop
        save(*args)
        if len(calls) == call:
            raise Stop

    monkeypatch.setattr(gpo_ppo, "save_checkpoint", save_or_stop)


def train_until_stopped(argv):
    """Runs main without keeping the exception, whose frames would hold the run folder's lock."""
    try:
        gpo_ppo.main(argv)
    except Stop:
        return
    pytest.fail("the run was not stopped")


@pytest.mark.parametrize("call, before", [(1, False), (2, False), (3, True), (3, False)])
def test_a_run_that_was_stopped_ends_as_if_it_had_not(
    call, before, base_run, tiny, train, assert_same_run, tmp_path, monkeypatch
):
    """Stopped at the start, after round one, when round two's lineage is written but its checkpoint is not, and at the end."""
    with monkeypatch.context() as patch:
        stop_at(patch, call, before)
        train_until_stopped(tiny(tmp_path, population=3, total_timesteps=2400, run_name="run"))
    assert not (tmp_path / "run" / "evaluation.json").exists()
    moved = tmp_path / "elsewhere" / "moved"
    moved.parent.mkdir()
    (tmp_path / "run").rename(moved)
    result = gpo_ppo.main(["--resume", str(moved), "--workers", "1"])
    run = type(base_run)(
        folder=moved, evaluation=result, checkpoint=torch.load(moved / "checkpoint.pt", weights_only=True), lineage=None
    )
    assert_same_run(base_run, run)
    ours, expected = read_events(moved)[0], read_events(base_run.folder)[0]
    assert {tag: [s for s, _ in points] for tag, points in ours.items()} == {
        tag: [s for s, _ in points] for tag, points in expected.items()
    }
    for tag in set(expected) - {tag for tag in expected if tag.startswith("time/")} - {"charts/SPS"}:
        np.testing.assert_array_equal([value for _, value in ours[tag]], [value for _, value in expected[tag]])


@pytest.mark.slow
def test_workers_go_on_from_a_checkpoint_of_another_number_of_workers(base_run, tiny, assert_same_run, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, 2, False)
        train_until_stopped(tiny(tmp_path, population=3, total_timesteps=2400, run_name="run"))
    gpo_ppo.main(["--resume", str(tmp_path / "run"), "--workers", "2"])
    run = type(base_run)(folder=tmp_path / "run", checkpoint=torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True))
    assert_same_run(base_run, run)


def test_resuming_a_finished_run_changes_nothing(train, tmp_path):
    run = train(tmp_path)
    before = [(run.folder / name).read_bytes() for name in ("evaluation.json", "lineage.jsonl")]
    assert gpo_ppo.main(["--resume", str(run.folder), "--workers", "1"]) == run.evaluation
    assert [(run.folder / name).read_bytes() for name in ("evaluation.json", "lineage.jsonl")] == before


# ---------------------------------------------------------------- any Gymnasium environment, any setting


def test_observations_and_actions_that_are_not_flat(train, tmp_path):
    run = train(tmp_path, env_id="gpo_test/Line-v0", total_timesteps=3000)
    saved = torch.load(run.folder / "policy.pt", weights_only=True)
    assert saved["sizes"] == [4, 64, 64, 1] and saved["max_episode_steps"] == 64
    assert run.args["env_id"] == "gpo_test/Line-v0" and -64 * 3 < run.evaluation["best"] < 0
    mean, std = saved["mean"].numpy(), 1 / saved["inv_std"].numpy()
    np.testing.assert_allclose(mean[1:], [1, mean[0] / 2, -1], rtol=1e-4)  # [[x, 1], [x / 2, -1]]
    np.testing.assert_allclose(std[1:], [0, std[0] / 2, 0], rtol=1e-4, atol=2e-4)


def test_environment_keywords_reach_the_environment(train, tmp_path):
    far = train(tmp_path / "far", env_id="gpo_test/Line-v0", env_kwargs='{"start": 1.9}').evaluation["best"]
    near = train(tmp_path / "near", env_id="gpo_test/Line-v0", env_kwargs='{"start": 0.001}').evaluation["best"]
    assert far < near - 10


@pytest.mark.slow
def test_population_learns_to_stay_at_zero(train, tmp_path):
    """What all operators together are for: Line's episodes return about -24 untrained, -3 at best."""
    settings = dict(population=4, num_steps=128, num_envs=4, rounds=3, dagger_iterations=5, dagger_epochs=10, pi_s_epochs=20)
    settings |= dict(max_episode_steps=32, critic_epochs=10, total_timesteps=60_000, student_steps=100, expert_steps=500)
    run = train(tmp_path, env_id="gpo_test/Line-v0", **settings, report_episodes=20, comparison_episodes=20)
    assert run.evaluation["mean"] > -10 and run.evaluation["best"] > -8
    first, last = run.lineage[0]["child_return"], run.lineage[-1]["child_return"]
    assert last > first


@pytest.mark.parametrize("kind", ["copy", "parameter"])
def test_crossover_ablations_in_a_run(train, tmp_path, kind):
    run = train(tmp_path, crossover=kind, fitness="mixture", selection="fitness", data_sharing=False)
    kept = torch.load(run.folder / "crossover_001.pt", weights_only=True)
    assert kept["pi_s"] is None and run.evaluation["global_step"] == 6 * 256
    parents, stronger = kept["parents"], kept["fitness"].argmax()
    for child in kept["children"]:
        assert ((child == parents[0]) | (child == parents[1])).all()
        assert torch.equal(child, parents[stronger]) == (kind == "copy")
    scalars = read_events(run.folder)[0]
    assert {value for _, value in scalars["sharing/size"]} == {1.0}


def test_sharing_uses_other_members_samples(train, tmp_path):
    """At the start all policies look alike, so with any threshold above 0 every S_i holds everyone."""
    runs = {}
    for name, changes in {"all": {}, "off": {"data_sharing": False}, "none": {"kl_sharing_threshold": 0.0}}.items():
        runs[name] = train(tmp_path / name, rounds=1, **changes)
    assert read_events(runs["all"].folder)[0]["sharing/size"][0][1] == 2
    policies = {name: run.checkpoint["population"]["policies"] for name, run in runs.items()}
    assert torch.equal(policies["off"], policies["none"]) and not torch.equal(policies["all"], policies["off"])


@pytest.mark.parametrize("critic_warmup, updates", [(0, 4), (1, 3), (9, 3)])
def test_first_iterations_after_a_crossover_fit_only_the_critic(critic_warmup, updates, train, tmp_path, monkeypatch):
    """Two rounds of two iterations; at least one iteration of a round always improves the policies."""
    update, calls = gpo_ppo.ppo_update, []

    def counting(*args):
        calls.append(1)
        return update(*args)

    monkeypatch.setitem(gpo_ppo.SCRIPT, "train", lambda args: gpo_ppo.train_gpo(args, counting))
    train(tmp_path, critic_warmup=critic_warmup)
    assert len(calls) == updates


def test_a_child_inherits_critic_and_kl_coef_of_its_stronger_parent(train, tmp_path, monkeypatch):
    breed, rounds = gpo_ppo.breed, []

    def recording(*args):
        (population,) = [x for x in args if hasattr(x, "critics")]
        before = {name: getattr(population, name).clone() for name in ("critics", "kl_coefs", "ids")}
        breed(*args)
        rounds.append((before, {name: getattr(population, name).clone() for name in before}))

    monkeypatch.setattr(gpo_ppo, "breed", recording)
    run = train(tmp_path, population=3, total_timesteps=2400, kl_target=0.05, learning_rate=0.01)
    sides = set()
    for line in run.lineage:
        before, after = rounds[line["round"] - 1]
        side = int(np.argmax(line["parent_fitness"]))
        heir = before["ids"].tolist().index(line["parents"][side])
        assert torch.equal(after["critics"][line["slot"]], before["critics"][heir])
        assert after["kl_coefs"][line["slot"]] == before["kl_coefs"][heir]
        sides.add(side)
    assert sides == {0, 1}


@pytest.mark.filterwarnings("ignore:.*not within the observation space.*", "ignore:.*NaN value.*")
@pytest.mark.parametrize("broken_after", [1, 2])
def test_a_broken_member_does_not_breed_nor_spoil_the_others(broken_after, train, tmp_path, monkeypatch):
    """Member 1's policy becomes NaN in one of round one's two updates: no child descends from it, all numbers are finite.

    Broken in the first, it collects a batch of NaN, which must enter neither the normalizer nor the others' gradients.
    """
    update, calls = gpo_ppo.ppo_update, []

    def breaking(args, policy, *rest):
        result = update(args, policy, *rest)
        calls.append(1)
        if len(calls) == broken_after:
            policy.flat[1] = math.nan
        return result

    monkeypatch.setitem(gpo_ppo.SCRIPT, "train", lambda args: gpo_ppo.train_gpo(args, breaking))
    run = train(tmp_path, population=3, total_timesteps=2400)
    assert [line["parents"] for line in run.lineage[:3]] == [[0, 2]] * 3
    assert len({tuple(line["parents"]) for line in run.lineage[3:]}) == 3
    assert all(math.isfinite(member["report_return"]) for member in run.evaluation["members"])
    assert all(stack.isfinite().all() for stack in run.checkpoint["population"].values())


# ---------------------------------------------------------------- bad input


def gym_register_once(env_id, **kwargs):
    if env_id not in gym.registry:
        gym.register(env_id, **kwargs)


class Choices(gym.Env):
    """Box actions, but observations that are no numbers in a box."""

    observation_space, action_space = gym.spaces.Discrete(3), gym.spaces.Box(-1, 1, (1,))


gym_register_once("gpo_test/Choices-v0", entry_point=Choices)

BAD_INPUT = [
    ("--env-id Pendulun-v1", ["Pendulun", "Did you mean", "Pendulum"]),
    ("--env-id Pendulum-v9", ["Pendulum", "v1"]),
    ("--env-id HalfCheeta-v4", ["Did you mean", "HalfCheetah"]),
    ("--env-id no_such_namespace/Thing-v0", ["no_such_namespace"]),
    ("--env-id CartPole-v1", ["Discrete(2)", "Box", "action"]),
    ("--env-id gpo_test/Choices-v0", ["Discrete(3)", "Box", "observation"]),
    ("--population 1", ["--population 1", "2"]),
    ("--population 0", ["--population 0"]),
    ("--population 8 --workers 9", ["--workers 9", "--population 8"]),
    ("--workers 0", ["--workers 0"]),
    ("--total-timesteps 495", ["--total-timesteps 495", "496"]),
    ("--total-timesteps -1", ["--total-timesteps -1"]),
    ("--learning-rate -0.001", ["--learning-rate -0.001", "> 0"]),
    ("--learning-rate 0", ["--learning-rate 0"]),
    ("--learning-rate nan", ["--learning-rate nan"]),
    ("--learning-rate inf", ["--learning-rate inf"]),
    ("--critic-learning-rate -1", ["--critic-learning-rate -1"]),
    ("--crossover-learning-rate nan", ["--crossover-learning-rate nan"]),
    ("--gamma 1.01", ["--gamma 1.01", "[0, 1]"]),
    ("--gamma nan", ["--gamma nan"]),
    ("--kl-target -1", ["--kl-target -1"]),
    ("--kl-sharing-threshold nan", ["--kl-sharing-threshold nan"]),
    ("--importance-clip 0", ["--importance-clip 0"]),
    ("--importance-clip nan", ["--importance-clip nan"]),
    ("--expert-steps 9", ["--expert-steps 9", "10"]),
    ("--seed -1", ["--seed -1"]),
    ("--env-kwargs {", ["--env-kwargs", "JSON object"]),
    ("--env-kwargs [1]", ["--env-kwargs", "JSON object"]),
    ('--env-kwargs {"no_such_keyword":1}', ["no_such_keyword"]),
    ('--env-id HalfCheetah-v4 --env-kwargs {"no_such_keyword":1}', ["no_such_keyword"]),
    ('--env-id rllab/HalfCheetah-v0 --env-kwargs {"no_such_keyword":1}', ["no_such_keyword"]),
]
if not torch.cuda.is_available():
    BAD_INPUT.append(("--cuda", ["--cuda"]))


def refusal(argv, capfd):
    """Runs main, which must refuse: exit code 2 and one line on stderr, which is returned."""
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        gpo_ppo.main(argv)
    captured = capfd.readouterr()
    assert stop.value.code == 2
    assert captured.err.count("\n") == 1 and captured.err.endswith("\n") and "error: " in captured.err, captured.err
    assert "Traceback" not in captured.err and captured.out == ""
    return captured.err


@pytest.mark.parametrize("words, said", BAD_INPUT, ids=[words for words, _ in BAD_INPUT])
def test_bad_input_gets_one_line_and_no_folder(words, said, tiny, tmp_path, capfd):
    message = refusal([*tiny(tmp_path / "runs"), *words.split()], capfd)
    assert all(part in message for part in said), message
    assert list(tmp_path.iterdir()) == []


def test_bad_input_on_the_command_line(tiny, tmp_path):
    """The whole of a user's view, with the default number of workers."""
    argv = tiny(tmp_path / "runs", env_id="HalfCheeta-v4")
    done = command_line(*argv, cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("gpo_ppo.py: error: --env-id HalfCheeta-v4"), done.stderr
    assert list(tmp_path.iterdir()) == []


def test_unwritable_run_dir(tiny, tmp_path, capfd):
    (tmp_path / "file").write_text("mine")
    for run_dir in (tmp_path / "file", tmp_path / "file" / "below", "/proc/runs"):
        assert str(run_dir) in refusal(tiny(run_dir), capfd)
    assert (tmp_path / "file").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_unknown_flags_and_values_are_refused(tiny, tmp_path, capfd):
    for words in (["--no-such-flag", "1"], ["--selection", "best"], ["--population", "eight"], ["--learning-rate"]):
        with pytest.raises(SystemExit) as stop:
            gpo_ppo.main([*tiny(tmp_path / "runs"), *words])
        captured = capfd.readouterr()
        assert stop.value.code == 2 and words[0] in captured.err and "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


class Bomb:
    """Unpickled by a careless loader, it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("content", ["nothing", "garbage", "empty", "truncated", "bomb", "other", "older", "list"])
def test_resume_of_what_is_no_checkpoint(content, base_run, tmp_path, capfd):
    folder, path = tmp_path / "run", tmp_path / "run" / "checkpoint.pt"
    folder.mkdir()
    good = base_run.folder / "checkpoint.pt"
    if content == "garbage":
        path.write_bytes(os.urandom(1000))
    elif content == "empty":
        path.touch()
    elif content == "truncated":
        path.write_bytes(good.read_bytes()[:-5000])
    elif content == "bomb":
        torch.save({**base_run.checkpoint, "progress": Bomb(tmp_path / "exploded")}, path)
    elif content == "other":
        torch.save({"format": 1, "flags": {"env_id": "Pendulum-v1"}}, path)
    elif content == "older":
        torch.save({**base_run.checkpoint, "format": 0}, path)
    elif content == "list":
        torch.save([1, 2], path)
    before = sorted(tmp_path.rglob("*"))
    message = refusal(["--resume", str(folder)], capfd)
    assert str(folder) in message and "checkpoint.pt" in message
    assert sorted(tmp_path.rglob("*")) == before
    missing = refusal(["--resume", str(tmp_path / "nowhere")], capfd)
    assert "nowhere" in missing and not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("words", ["--seed 5", "--env-id Walker2d-v4", "--population 4", "--no-data-sharing"])
def test_a_resumed_run_keeps_its_flags(words, base_run, tmp_path, capfd):
    shutil.copytree(base_run.folder, tmp_path / "run")
    message = refusal(["--resume", str(tmp_path / "run"), *words.split()], capfd)
    assert words.split()[0].replace("--no-", "--") in message


def test_a_live_runs_folder_cannot_be_resumed_or_used(base_run, tiny, train, tmp_path, monkeypatch, capfd):
    """Tried from the middle of a run, when its folder holds a checkpoint."""
    select, messages = gpo_ppo.select, []

    def trying(*args):
        folder = tmp_path / "run"
        messages.append(refusal(["--resume", str(folder), "--workers", "1"], capfd))
        messages.append(refusal(tiny(tmp_path, run_name="run"), capfd))
        return select(*args)

    with monkeypatch.context() as patch:
        patch.setattr(gpo_ppo, "select", trying)
        run = train(tmp_path, rounds=1)
    assert len(messages) == 2 and all("live run" in message for message in messages)
    assert run.evaluation["global_step"] == 1520


# ---------------------------------------------------------------- alone


def test_a_script_copied_alone_runs_gymnasiums_ids(tiny, tmp_path):
    shutil.copy(ROOT / "gpo_ppo.py", tmp_path)
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "gpo_ppo.py", *tiny("runs", env_id="HalfCheetah-v4", rounds=1)],
        **dict(cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300),
    )
    assert done.returncode == 0, done.stderr
    assert (done.stdout + done.stderr).count("SyncVectorEnv") == 1
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "evaluation.json").exists()
