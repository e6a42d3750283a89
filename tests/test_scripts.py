"""What the four scripts have in common, and what each baseline and A2C must do."""

import ast
import difflib
import json
import math
import re
import shutil
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.multiprocessing
from conftest import flags

import gpo_a2c
import gpo_ppo
import joint_baseline
import single_baseline
from benchmark import crossover as crossover_benchmark

ROOT = Path(__file__).parent.parent
NAMES = ("gpo_ppo", "gpo_a2c", "single_baseline", "joint_baseline")
SOURCES = {name: (ROOT / f"{name}.py").read_text() for name in NAMES}
BASELINES = {"single_baseline": single_baseline, "joint_baseline": joint_baseline}
SCRIPTS = {"gpo_ppo": gpo_ppo, "gpo_a2c": gpo_a2c, **BASELINES}
RUNS = [("gpo_ppo", {}), ("gpo_a2c", {})] + [(script, {"algo": algo}) for script in BASELINES for algo in ("ppo", "a2c")]

TINY = {
    "env_id": "Pendulum-v1",
    "population": 3,
    "num_steps": 32,
    "num_envs": 2,
    "max_episode_steps": 32,
    "critic_epochs": 2,
    "critic_minibatch_size": 32,
    "selection_episodes": 1,
    "report_episodes": 2,
    "workers": 1,
    "run_name": "run",
}
TINY_GPO = {
    "rounds": 2,
    "expert_steps": 50,
    "student_steps": 10,
    "dagger_iterations": 1,
    "dagger_epochs": 1,
    "pi_s_epochs": 1,
    "comparison_episodes": 1,
}


def command(name, run_dir, **changes):
    """The command line of a run of a second or less."""
    own = {} if name in BASELINES else TINY_GPO
    segments = {"segments": 2} if name in BASELINES else {}
    return flags(**{**TINY, "total_timesteps": 1000, **own, **segments, "run_dir": run_dir, **changes})


def load(folder):
    return torch.load(Path(folder) / "checkpoint.pt", weights_only=True)["population"]


# ---------------------------------------------------------------- one piece of code


def definitions(source):
    """{name: [source text of each top-level function, class or constant of this name]}, Args excluded."""
    found, lines = defaultdict(list), source.splitlines()
    for node in ast.parse(source).body:
        names = []
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names = [node.name]
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [x.id for target in targets for x in ast.walk(target) if isinstance(x, ast.Name)]
        start = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        for name in names:
            found[name].append("\n".join(lines[start - 1 : node.end_lineno]))
    return {name: texts for name, texts in found.items() if name != "Args"}


def flags_of(source):
    """{flag: (type, default, help)} of all groups that Args has, and {field of Args: its declaration}."""
    classes = {node.name: node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)}
    groups, table = {}, {}
    for field in classes["Args"].body:
        groups[field.target.id] = ast.unparse(field)
        body = classes[field.annotation.id].body
        for flag, text in zip(body[::2], body[1::2], strict=True):
            assert flag.target.id not in table
            table[flag.target.id] = ast.unparse(flag.annotation), ast.unparse(flag.value), text.value.value
    return groups, table


def test_what_stands_in_two_scripts_is_the_same_to_the_letter():
    first = {}
    for script, source in SOURCES.items():
        for name, texts in definitions(source).items():
            assert len(texts) == 1, f"{script}.py defines {name} twice"
            known, text = first.setdefault(name, (script, texts[0]))
            assert texts[0] == text, f"{name} in {script}.py differs from {known}.py's"
    assert len(definitions(SOURCES["gpo_ppo"]).keys() & definitions(SOURCES["joint_baseline"])) > 60


def test_a_flag_is_the_same_in_all_scripts_that_have_it():
    first = {}
    for script, source in SOURCES.items():
        for table in flags_of(source):
            for name, declaration in table.items():
                known, expected = first.setdefault((name, type(declaration)), (script, declaration))
                assert declaration == expected, f"{name} in {script}.py differs from {known}.py's"


def test_comparison_notices_a_changed_letter():
    changed = SOURCES["gpo_ppo"].replace("0.9, beta2=0.999", "0.9, beta2=0.99")
    assert definitions(changed)["adam_step"] != definitions(SOURCES["gpo_ppo"])["adam_step"]
    changed = SOURCES["gpo_ppo"].replace("gamma: Annotated", "gamma : float = 1\n    '''g'''\n    gam: Annotated")
    assert flags_of(changed)[1]["gamma"] != flags_of(SOURCES["gpo_ppo"])[1]["gamma"]


@pytest.mark.parametrize("script", NAMES)
def test_a_script_uses_all_that_it_defines(script):
    used = {node.id for node in ast.walk(ast.parse(SOURCES[script])) if isinstance(node, ast.Name)}
    unused = [name for name in definitions(SOURCES[script]) if name not in used]
    assert not unused
    flags = [
        flag for flag in flags_of(SOURCES[script])[1] if not re.search(rf'args\.{flag}\b|args, "{flag}"', SOURCES[script])
    ]
    assert not flags


@pytest.mark.parametrize("script", BASELINES)
def test_a_baseline_has_no_word_about_what_it_does_not_do(script):
    words = r"crosso|couple|\bchild|parent|pi_s\b|\bshar(e|ed|ing)\b|lineage|dagger|breed|distill\b|generation|\bmutat|student"
    harmless = (
        r"processes that share the work|No stream is shared|and share nothing|folder\.parent|parents=True|ChildFailedError"
    )
    text = re.sub(harmless, "", SOURCES[script])
    assert not [line for line in text.splitlines() if re.search(words, line, re.IGNORECASE)]


def test_differences_read_as_what_a2c_changes():
    lines = list(difflib.unified_diff(SOURCES["gpo_ppo"].splitlines(), SOURCES["gpo_a2c"].splitlines(), n=0))
    changed = [line for line in lines[2:] if line[0] in "+-"]
    assert 0 < len(changed) < 120
    assert all(SOURCES[script].count("\n") < SOURCES["gpo_ppo"].count("\n") for script in BASELINES)


def test_no_script_imports_another():
    for script, source in SOURCES.items():
        imported = {alias.name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import) for alias in node.names}
        imported |= {node.module for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)}
        assert not imported & (set(NAMES) | {"benchmark"}), script


# ---------------------------------------------------------------- A2C


def random_batch(rng, args, policy=None, samples=7):
    """A batch in the layout of `make_batches`; acted by `policy`, or by some other policy if None."""
    obs, actions, noise = (
        torch.from_numpy(rng.standard_normal((1, n, samples)).astype(np.float32))
        for n in (args.obs_dim, args.act_dim, args.act_dim)
    )
    batch = SimpleNamespace(obs=obs, actions=actions)
    if policy is None:
        batch.mean, batch.log_std = noise, torch.full((1, args.act_dim, 1), -0.2)
    else:
        batch.mean, batch.log_std = gpo_a2c.forward(policy, obs)[-1], policy.log_std.clone()
    batch.log_probs = gpo_a2c.gaussian_log_prob(actions, batch.mean, batch.log_std)
    batch.advantages = torch.from_numpy(rng.standard_normal((1, samples)).astype(np.float32))
    return batch


def random_policy(rng, args, members=1):
    flat = torch.from_numpy(0.3 * rng.standard_normal((members, policy_width(args))).astype(np.float32))
    flat[:, policy_width(args, padded=False) :] = 0
    return gpo_a2c.make_policy(flat, args)


def policy_width(args, padded=True):
    sizes = gpo_a2c.policy_sizes(args)
    count = sum(a * b + b for a, b in zip(sizes, sizes[1:])) + args.act_dim
    return math.ceil(count / 16) * 16 if padded else count


def slow_a2c_loss(flat, args, batches, clip):
    """-L^A2C of Section 3.2.2, sample by sample, from one policy's flat parameters."""
    sizes, at, layers = gpo_a2c.policy_sizes(args), 0, []
    for n_in, n_out in zip(sizes, sizes[1:]):
        layers.append((flat[at : at + n_in * n_out].view(n_out, n_in), flat[at + n_in * n_out : at + n_in * n_out + n_out]))
        at += n_in * n_out + n_out
    log_std, loss = flat[at : at + args.act_dim], 0.0
    for k, batch in enumerate(batches):
        for t in range(batch.obs.shape[2]):
            h = batch.obs[0, :, t].double()
            for W, b in layers[:-1]:
                h = torch.tanh(W @ h + b)
            mean = layers[-1][0] @ h + layers[-1][1]
            log_prob = torch.distributions.Normal(mean, log_std.exp()).log_prob(batch.actions[0, :, t].double()).sum()
            advantage, ratio = batch.advantages[0, t].double(), torch.exp(log_prob - batch.log_probs[0, t].double())
            if k == 0:
                term = log_prob  # the paper's L^A2C without data-sharing
            else:
                term = ratio if ratio <= clip else clip * log_prob
            loss = loss - term * advantage / batch.obs.shape[2]
    return loss


@pytest.mark.parametrize("clip", [math.inf, 1.0, 0.5])
@pytest.mark.parametrize("borrowed", [0, 2])
def test_a2c_gradient_is_autograds_of_a_slow_loop(make_args, borrowed, clip):
    args, rng = make_args(), np.random.default_rng(borrowed)
    policy = random_policy(rng, args)
    batches = [random_batch(rng, args, policy)] + [random_batch(rng, args) for _ in range(borrowed)]
    loss = gpo_a2c.a2c_gradient(policy, batches, clip)
    flat = policy.flat[0].double().requires_grad_()
    slow = slow_a2c_loss(flat, args, batches, clip)
    (expected,) = torch.autograd.grad(slow, flat)
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(policy.grad[0].double(), expected, rtol=1e-4, atol=1e-6 * expected.abs().max().item())
    ratios = [
        torch.exp(gpo_a2c.gaussian_log_prob(b.actions, gpo_a2c.forward(policy, b.obs)[-1], policy.log_std) - b.log_probs)
        for b in batches
    ]
    surrogates = [
        (r.clamp(max=clip if k else math.inf) * b.advantages).mean() for k, (r, b) in enumerate(zip(ratios, batches))
    ]
    assert loss == pytest.approx(-sum(surrogates).item(), rel=1e-5)
    if borrowed and clip < math.inf:  # the cap was met, and also not met
        assert (torch.cat(ratios[1:]) > clip).any() and (torch.cat(ratios[1:]) < clip).any()


def test_a2c_update_is_one_step_of_adam_for_each_member(make_args):
    args, rng = make_args(importance_clip=1.0), np.random.default_rng(3)
    policy = random_policy(rng, args, members=2)
    before = policy.flat.clone()
    own = [random_batch(rng, args, row) for row in policy.rows]
    borrowed, kl_coefs = [[random_batch(rng, args)], []], torch.zeros(2)
    gpo_a2c.adam(policy)
    losses, kls = gpo_a2c.a2c_update(args, policy, own, borrowed, kl_coefs)
    for i in range(2):
        flat = before[i].double().requires_grad_()
        optimizer = torch.optim.Adam([flat], lr=args.learning_rate, eps=1e-5)
        slow_a2c_loss(flat, args, [own[i], *borrowed[i]], 1.0).backward()
        optimizer.step()
        torch.testing.assert_close(policy.flat[i].double(), flat.detach(), rtol=1e-4, atol=1e-5)
        assert kls[i] == gpo_a2c.policy_kl(policy.rows[i], own[i]) > 0
    assert len(losses) == 2


# ---------------------------------------------------------------- the run of all four


@pytest.mark.parametrize("script, algo", RUNS)
def test_a_run_counts_its_steps_meets_its_budget_and_goes_on(script, algo, tmp_path, monkeypatch):
    """Every step of every environment is counted; a run from a checkpoint in its middle ends with the same numbers."""
    module, steps, evaluating = SCRIPTS[script], {True: 0, False: 0}, [False]
    rollout, evaluate, save = module.rollout, module.evaluate, module.save_checkpoint

    def counting_rollout(envs, obs, act, num_steps):
        steps[evaluating[0]] += len(obs) * num_steps
        return rollout(envs, obs, act, num_steps)

    def marked_evaluate(*arguments, **keywords):
        evaluating[0] = True
        returns = evaluate(*arguments, **keywords)
        evaluating[0] = False
        return returns

    def save_and_keep(args, run, population):
        save(args, run, population)
        if run.progress["segment"] == 1 and run.folder.name == "run":
            shutil.copytree(run.folder, tmp_path / "middle")

    monkeypatch.setattr(module, "rollout", counting_rollout)
    monkeypatch.setattr(module, "evaluate", marked_evaluate)
    monkeypatch.setattr(module, "save_checkpoint", save_and_keep)
    result = module.main(command(script, tmp_path, **algo))
    assert steps == {False: result["global_step"], True: result["evaluation_steps"]}
    assert 1000 - 3 * 2 * 32 < result["global_step"] <= 1000
    again = module.main(["--resume", str(tmp_path / "middle")])
    assert again == result
    for name, stack in load(tmp_path / "run").items():
        assert torch.equal(stack, load(tmp_path / "middle")[name]), name
    members, stacks = 1 if script == "joint_baseline" else 3, load(tmp_path / "run")
    assert len(result["members"]) == members and all(len(stack) == members for stack in stacks.values())
    if script in BASELINES:  # own statistics of all that was seen, and moments that are not started afresh in a new segment
        iterations = result["global_step"] // (3 * 2 * 32)
        assert stacks["obs_count"].tolist() == [result["global_step"] / members] * members
        assert all(stacks[f"{name}_{moment}"].any() for name in ("policies", "critics") for moment in ("mean", "square"))
        assert stacks["policies_step"].tolist() == [iterations * {"ppo": 10, "a2c": 1}[algo["algo"]]] * members
        assert (
            stacks["critics_step"].tolist() == [iterations * 2 * 2] * members
        )  # 2 epochs of 2 minibatches per member or shard


@pytest.mark.parametrize("total", [192, 1000, 999_999, 8_000_000])
def test_baselines_plan_their_budget_to_less_than_an_iteration(make_args, total):
    args = make_args(population=3, num_envs=2, num_steps=32, total_timesteps=total, segments=12)
    plan, steps = single_baseline.plan_segments(args)
    assert total - 3 * 2 * 32 < steps == sum(plan) * 3 * 2 * 32 <= total
    assert len(plan) == min(12, sum(plan)) and max(plan) - min(plan) <= 1 and min(plan) > 0


def test_a_budget_below_one_iteration_is_refused_with_the_smallest(tmp_path, capsys):
    for script, module in BASELINES.items():
        with pytest.raises(SystemExit) as stop:
            module.main(command(script, tmp_path, total_timesteps=191))
        assert stop.value.code == 2 and "one iteration takes 192 steps" in capsys.readouterr().err


def test_only_gpo_refuses_a_population_of_one(tmp_path, capsys):
    for script, module in SCRIPTS.items():
        argv = command(script, tmp_path / script, population=1, total_timesteps=200)
        if script in BASELINES:
            assert len(module.main(argv)["members"]) == 1
        else:
            with pytest.raises(SystemExit) as stop:
                module.main(argv)
            assert stop.value.code == 2 and "--population 1" in capsys.readouterr().err


def test_all_leave_the_same_files_and_scalars(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    files, tags, keys = {}, {}, {}
    for script, module in SCRIPTS.items():
        module.main(command(script, tmp_path / script))
        folder = tmp_path / script / "run"
        files[script] = {path.name for path in folder.iterdir() if not path.name.startswith("events")}
        events = EventAccumulator(str(folder)).Reload()
        tags[script] = set(events.Tags()["scalars"])
        steps = [event.step for event in events.Scalars("losses/value_loss")]
        assert len(steps) > 1 and steps == sorted(set(steps))
        keys[script] = set(json.loads((folder / "evaluation.json").read_text()))
        if script in BASELINES:
            assert module.load_checkpoint(folder)["flags"]["env_id"] == "Pendulum-v1"
            assert (json.loads((folder / "args.json").read_text()))["exp_name"] is None
    gpo_only = {"lineage.jsonl", "crossover_001.pt"}
    assert files["gpo_ppo"] == files["gpo_a2c"] == files["single_baseline"] | gpo_only == files["joint_baseline"] | gpo_only
    assert tags["gpo_ppo"] == tags["gpo_a2c"] and len(set(map(frozenset, keys.values()))) == 1
    own = r"crossover/|sharing/|population/diversity|time/(sharing|select|crossover|comparison|pi_s|dagger)"
    assert {tag for tag in tags["gpo_ppo"] if not re.match(own, tag)} == tags["single_baseline"]
    slots = {"population/return_1", "population/return_2"}  # Joint has one policy
    assert tags["single_baseline"] - slots == tags["joint_baseline"]


def test_run_names_tell_the_scripts_apart(tmp_path, monkeypatch):
    for script, module in BASELINES.items():
        for algo in ("ppo", "a2c"):
            argv = command(script, tmp_path, algo=algo)
            at = argv.index("--run-name")
            args = module.parse_args(argv[:at] + argv[at + 2 :])
            assert args.exp_name == f"{script.split('_')[0]}_{algo}" and f"__{args.exp_name}__1__" in args.run_name


@pytest.mark.slow
@pytest.mark.parametrize("script, algo", RUNS)
def test_results_do_not_depend_on_the_number_of_workers(script, algo, tmp_path):
    """To the bit, with shapes that do not divide into whole vectors."""
    odd = {"num_envs": 3, "num_steps": 35, "critic_minibatch_size": 50, **algo}
    run = SCRIPTS[script].main
    results = [run(command(script, tmp_path, workers=w, run_name=w, total_timesteps=1400, **odd)) for w in (1, 2, 3)]
    assert results[0] == results[1] == results[2]
    for name, stack in load(tmp_path / "1").items():
        assert torch.equal(stack, load(tmp_path / "2")[name]) and torch.equal(stack, load(tmp_path / "3")[name]), name


# ---------------------------------------------------------------- Single


@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_a_member_of_single_equals_the_same_member_alone(algo, tmp_path, monkeypatch):
    """Odd shapes, so that rows of a stack do not stand at whole vectors."""
    odd = {"algo": algo, "num_envs": 3, "num_steps": 35, "critic_minibatch_size": 50, "total_timesteps": 1400}
    together = single_baseline.main(command("single_baseline", tmp_path, **odd))
    assert sorted(together["members"], key=lambda x: x["selection_return"])[-1]["report_return"] == together["best"]
    for slot in range(3):
        monkeypatch.setattr(single_baseline, "local_slots", lambda population, slot=slot: [slot])
        alone = single_baseline.main(command("single_baseline", tmp_path, **odd, run_name=f"alone{slot}"))
        assert alone["members"] == together["members"][slot : slot + 1]
        for name, stack in load(tmp_path / f"alone{slot}").items():
            assert torch.equal(stack[0], load(tmp_path / "run")[name][slot]), name
    stacks = load(tmp_path / "run")
    for name in ("policies", "critics", "obs_mean", "return_square"):  # the members are not each other's copies
        assert not torch.equal(stacks[name][0], stacks[name][1]) and not torch.equal(stacks[name][1], stacks[name][2])


@pytest.mark.filterwarnings("ignore")
def test_a_broken_member_of_single_is_not_the_best_and_harms_no_other(tmp_path, monkeypatch):
    sound = single_baseline.main(command("single_baseline", tmp_path))
    new_population = single_baseline.new_population

    def with_a_broken_member(args, slots):
        population = new_population(args, slots)
        population.policies[0] = math.nan
        return population

    monkeypatch.setattr(single_baseline, "new_population", with_a_broken_member)
    result = single_baseline.main(command("single_baseline", tmp_path, run_name="broken"))
    assert result["members"][1:] == sound["members"][1:] and math.isnan(result["members"][0]["report_return"])
    assert result["best_slot"] > 0 and math.isfinite(result["best"])


# ---------------------------------------------------------------- Joint

SHARDS, SAMPLES = 3, 35


def joint_problem(slots):
    """What the shards in slots hold of a fixed problem, with a policy, a critic and their moments."""
    args = SimpleNamespace(
        obs_dim=5, act_dim=2, update_epochs=3, kl_target=0.001, kl_hinge=100.0, learning_rate=3e-3, norm_adv=True
    )
    vars(args).update(critic_learning_rate=1e-3, critic_epochs=1, critic_minibatch_size=SAMPLES)
    n, own = len(slots), [np.random.default_rng(slot) for slot in slots]
    policy = joint_baseline.make_policy(random_policy(np.random.default_rng(9), args).flat.repeat(n, 1), args)
    critic_rows = joint_baseline.init_rows([np.random.default_rng(8)], joint_baseline.critic_sizes(args), 1.0)
    critic = joint_baseline.make_net(critic_rows.repeat(n, 1), joint_baseline.critic_sizes(args))
    batches = [random_batch(rng, args, policy.rows[0], SAMPLES) for rng in own]
    obs = torch.cat([batch.obs.mT for batch in batches])
    for net in (policy, critic):
        gpo_ppo.adam(net)
    return args, policy, critic, batches, obs, np.stack([rng.standard_normal(SAMPLES) for rng in own]), own


def joint_updates(slots, sizes):
    """All of Joint's updates on the local shards: parameters, moments, losses."""
    args, policy, critic, batches, obs, targets, own = joint_problem(slots)
    kl_coefs = torch.ones(len(slots), dtype=torch.float64)
    ppo = joint_baseline.joint_ppo_update(args, policy, batches, kl_coefs, sizes)
    a2c = joint_baseline.joint_a2c_update(args, policy, batches, kl_coefs, sizes)
    joint_baseline.update_joint_critic(args, critic, obs, targets, own, sizes)
    return [policy.flat, policy.grad, *policy.moments[:2], critic.flat, critic.grad, kl_coefs], [ppo, a2c]


def joint_rank(rank, rendezvous, folder):
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=2)
    with torch.no_grad():
        torch.save(joint_updates(joint_baseline.local_slots(SHARDS), [2, 1]), folder / f"{rank}.pt")
    torch.distributed.destroy_process_group()


def test_joint_on_two_processes_equals_one_to_the_bit(tmp_path):
    torch.multiprocessing.start_processes(joint_rank, (tmp_path / "rendezvous", tmp_path), nprocs=2, start_method="fork")
    with torch.no_grad():
        (tensors, facts), parts = joint_updates([0, 1, 2], [3]), [torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1)]
    for k, whole in enumerate(tensors):
        assert all(torch.equal(row, whole[0]) for row in whole)  # the copies have stayed equal
        assert torch.equal(torch.cat([part[0][k] for part in parts]), whole), k
    for k, (losses, kls) in enumerate(facts):
        assert [part[1][k][0] for part in parts] == [losses[:2], losses[2:]]
        assert [part[1][k][1] for part in parts] == [kls[:2], kls[2:]]
    assert tensors[-1][0] != 1  # beta has adapted


@torch.no_grad()
def test_joint_adapts_beta_to_the_mean_kl_of_its_shards():
    def kls_and_betas(kl_target):
        args, policy, _, batches, *_ = joint_problem([0, 1, 2])
        args.kl_hinge, args.kl_target, kl_coefs = 0.0, kl_target, torch.ones(3, dtype=torch.float64)
        return joint_baseline.joint_ppo_update(args, policy, batches, kl_coefs, [3])[1], kl_coefs.tolist()

    mean = np.mean(kls_and_betas(1.0)[0])
    assert kls_and_betas(mean)[1] == [1] * 3
    assert kls_and_betas(mean / 1.6)[1] == [2] * 3 and kls_and_betas(mean * 1.6)[1] == [0.5] * 3


def test_joint_gradient_is_that_of_the_union_of_its_shards():
    args, policy, critic, batches, obs, targets, own = joint_problem([0, 1, 2])
    row = policy.rows[0]
    union = {name: torch.cat([getattr(b, name) for b in batches], dim=-1) for name in ("obs", "actions", "mean", "log_probs")}
    union = SimpleNamespace(**union, log_std=batches[0].log_std)
    advantages = np.stack([rng.standard_normal(SAMPLES) * (1 + k) + k for k, rng in enumerate(own)])
    joint_baseline.set_advantages(args, [union], advantages.reshape(1, -1), advantages.reshape(1, -1))
    joint_baseline.set_advantages(args, batches, advantages, [advantages] * SHARDS)
    whole = torch.cat([batch.advantages for batch in batches], dim=-1)
    torch.testing.assert_close(whole, union.advantages)
    assert abs(whole.mean()) < 1e-5 and abs(batches[0].advantages.mean()) > 0.1

    policy.flat += 0.01  # away from the policy that acted, so that the KL has a gradient
    for gradient in (lambda *x: joint_baseline.ppo_gradient(*x, 2.0), joint_baseline.a2c_gradient):
        policy.grad.zero_()
        gradient(row, [union])
        expected = row.grad[0].clone()
        policy.grad.zero_()
        for net, batch in zip(policy.rows, batches):
            gradient(net, [batch])
        joint_baseline.average_gradient(policy, [3])
        for mean in policy.grad:
            torch.testing.assert_close(mean, expected, rtol=1e-4, atol=1e-6)

    start = critic.flat[0].clone()
    joint_baseline.update_joint_critic(args, critic, obs, targets, own, [3])
    one = joint_baseline.make_net(start[None].clone(), critic.sizes)
    gpo_ppo.adam(one)
    args.critic_minibatch_size = SHARDS * SAMPLES  # its one minibatch is the union
    single_baseline.update_critics(args, one, obs.reshape(1, -1, 5), targets.reshape(1, -1), own[:1])
    for row in range(SHARDS):
        torch.testing.assert_close(critic.grad[row], one.grad[0], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(critic.flat[row], one.flat[0], rtol=1e-4, atol=1e-5)


def test_joint_normalizes_advantages_over_all_shards_in_a_run(tmp_path, monkeypatch):
    set_advantages, seen = joint_baseline.set_advantages, []

    def watched(args, batches, advantages, pool):
        set_advantages(args, batches, advantages, pool)
        seen.append(torch.cat([batch.advantages for batch in batches]).double())

    monkeypatch.setattr(joint_baseline, "set_advantages", watched)
    joint_baseline.main(command("joint_baseline", tmp_path))
    for advantages in seen:
        assert advantages.shape == (3, 64) and abs(advantages.mean()) < 1e-6
        assert advantages.std(correction=0) == pytest.approx(1, abs=1e-5)
        assert abs(advantages.mean(1)).max() > 1e-3


# ---------------------------------------------------------------- benchmark/crossover.py


def test_crossover_comparison_of_a_run(tmp_path, capsys):
    gpo_ppo.main(command("gpo_ppo", tmp_path))
    result = crossover_benchmark.main([str(tmp_path / "run"), "--episodes", "3", "--output", str(tmp_path / "out")])
    printed, saved = capsys.readouterr().out, torch.load(tmp_path / "run" / "crossover_001.pt", weights_only=True)
    assert json.loads((tmp_path / "out" / "crossover.json").read_text()) == result
    assert (tmp_path / "out" / "crossover.csv").read_text().count("\n") == 4
    by_id = {}
    for row, (x, y) in zip(result["couples"], saved["couples"], strict=True):
        assert (row["first_parent_id"], row["second_parent_id"]) == (saved["ids"][x], saved["ids"][y])
        by_id |= {x: row["first_parent_return"], y: row["second_parent_return"]}
        stronger = max((x, y), key=lambda i: saved["fitness"][i])
        assert row["copy_return"] == by_id[stronger]  # on the same episodes, a copy plays as its original does
        assert len({row[f"{kind}_return"] for kind in ("state-space", "copy", "parameter")}) == 3
        assert row["first_parent_relative"] is None  # Pendulum's returns are negative
        assert f"{row['state-space_return']:.1f}" in printed


def test_ratios_are_to_the_first_parent():
    rows = [
        {"first_parent_return": 2.0, "second_parent_return": 3.0, "copy_return": 3.0, "copy_relative": 1.5},
        {"first_parent_return": 4.0, "second_parent_return": 3.0, "copy_return": 2.0, "copy_relative": 0.5},
    ]
    summary = crossover_benchmark.summarize(rows, ["first_parent", "second_parent", "copy"])
    assert summary == {"copy": {"mean_relative": 1.0, "as_good_as_both": 0.5}}


def test_crossover_comparison_refuses_a_folder_without_one(tmp_path, capsys):
    with pytest.raises(SystemExit):
        crossover_benchmark.main([str(tmp_path)])
    assert "crossover_001.pt" in capsys.readouterr().err
