"""benchmark/curves.py, lineage.py and enjoy.py on tiny runs; needs nothing beyond requirements.txt but scipy, for one test."""

import csv
import json
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import gpo_ppo
from benchmark import curves, enjoy, lineage


def refused(capsys, call, *args):
    """The one line with which a call ends the program."""
    with pytest.raises(SystemExit) as end:
        call(*args)
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1
    return error


def test_resample_is_the_mean_of_what_was_logged_since_the_last_grid_point():
    generator = np.random.default_rng(0)
    at = curves.grid(1000)
    steps = np.sort(generator.choice(np.arange(35, 900), 150, replace=False)).astype(float)
    values = generator.normal(size=150)
    result = curves.resample(steps, values, at)
    assert at[0] == 10 and at[-1] == 1000
    filled = []
    for k in range(100):
        inside = values[(steps > at[k] - 10) & (steps <= at[k])]
        if len(inside):
            filled.append(k)
            assert result[k] == pytest.approx(inside.mean())
    assert np.isnan(result[: filled[0]]).all() and np.isnan(result[filled[-1] + 1 :]).all()
    assert len(filled) < 90 and np.isfinite(result[filled[0] : filled[-1] + 1]).all()


def test_curves_of_seeds_and_settings(train, tmp_path, capsys):
    names = [(1, "state-space"), (2, "state-space"), (1, "copy")]
    runs = [train(tmp_path, seed=seed, crossover=kind, exp_name="gpo_ppo", run_name=f"{seed}{kind}") for seed, kind in names]
    read = [curves.read_run(run.folder) for run in runs]
    two, one = curves.read_curves(read)
    assert (two.label, two.seeds, two.band) == ("GPO (PPO), crossover=state-space", 2, "deviation of seeds")
    assert (one.label, one.seeds, one.band) == ("GPO (PPO), crossover=copy", 1, "none")
    alone = [curves.read_curves([run])[0] for run in read[:2]]
    np.testing.assert_allclose(two.mean, (alone[0].mean + alone[1].mean) / 2)
    np.testing.assert_allclose(two.high - two.mean, abs(alone[0].mean - alone[1].mean) / np.sqrt(2), atol=1e-9)
    assert alone[0].label == "GPO (PPO)" and alone[0].band == "worst to best member"
    finite = np.isfinite(alone[0].mean)
    assert finite.any() and (alone[0].low <= alone[0].mean)[finite].all() and (alone[0].mean <= alone[0].high)[finite].all()

    curves.write_csv([two, one], tmp_path / "results" / "curves.csv")
    with open(tmp_path / "results" / "curves.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == np.isfinite(two.mean).sum() + np.isfinite(one.mean).sum()
    budget = runs[0].args["total_timesteps"]
    assert all(float(row["steps"]) % (budget / 100) == 0 and np.isfinite(float(row["mean"])) for row in rows)

    assert "no such folder" in refused(capsys, curves.read_run, tmp_path / "absent")
    assert "no args.json" in refused(capsys, curves.read_run, tmp_path / "results")
    assert "no scalar" in refused(capsys, curves.read_scalar, runs[0].folder, "charts/absent")
    (tmp_path / "results" / "args.json").write_text("[1]")
    assert "does not hold the flags" in refused(capsys, curves.read_run, tmp_path / "results")


def test_lineage_tells_parents_children_and_the_winners_ancestry(base_run, capsys, tmp_path):
    family = lineage.read_lineage(base_run.folder)
    ancestors = lineage.ancestry(family)
    parents = {line["id"]: line["parents"] for line in base_run.lineage}
    assert ancestors[-1] == {base_run.evaluation["best_id"]}
    assert ancestors[1] == set(parents[base_run.evaluation["best_id"]])
    assert ancestors[0] == {founder for parent in ancestors[1] for founder in parents[parent]}

    lineage.main([str(base_run.folder)])
    text = capsys.readouterr().out
    for line in base_run.lineage:
        x, y = line["parents"]
        assert f"{x} + {y}" in text and f"{line['child_return']:.1f}" in text
    assert f"the winner is {family.winner}, return {base_run.evaluation['best']:.1f}" in text
    assert f"founders: {', '.join(map(str, sorted(ancestors[0])))}" in text

    (tmp_path / "lineage.jsonl").write_text("".join(json.dumps(line) + "\n" for line in base_run.lineage))
    unfinished = lineage.read_lineage(tmp_path)
    assert unfinished.winner == max(base_run.lineage[-3:], key=lambda line: line["child_return"])["id"]
    (tmp_path / "lineage.jsonl").write_text('{"id": 3}\n')
    assert "line 1 is not one of" in refused(capsys, lineage.read_lineage, tmp_path)
    assert "no lineage.jsonl" in refused(capsys, lineage.read_lineage, tmp_path / "absent")


def test_the_saved_policy_acts_as_the_one_in_training_to_the_bit(base_run):
    args, policy, stats, saved = enjoy.load_policy(base_run.folder)
    population = SimpleNamespace(**base_run.checkpoint["population"])
    slot = base_run.evaluation["best_slot"]
    assert saved["id"] == population.ids[slot] == base_run.evaluation["best_id"]
    obs = np.random.default_rng(0).normal(size=(3, 20, args.obs_dim)).astype(np.float32)
    noise = np.random.default_rng(1).normal(size=(1, 1, 20, args.act_dim)).astype(np.float32)
    for z in (noise, None):
        trained = gpo_ppo.sample_actions(gpo_ppo.make_policy(population.policies, args), gpo_ppo.statistics(population), z)
        loaded = gpo_ppo.sample_actions(policy, stats, z)
        actions = trained(obs.reshape(60, -1), 0).reshape(3, 20, -1)[slot]
        assert (loaded(obs[slot], 0) == actions).all()

    returns = gpo_ppo.evaluate(args, policy, stats, enjoy.PURPOSE, args.report_episodes)
    assert returns.mean() == base_run.evaluation["best"]
    env = gym.make(args.env_id, max_episode_steps=args.max_episode_steps)
    shown = enjoy.play(args, env, policy, stats, args.report_episodes, 2, False)
    np.testing.assert_allclose(shown, returns[0, :2], rtol=1e-12)
    env.close()


def test_enjoy_prints_mean_deviation_and_interval(base_run, capsys):
    pytest.importorskip("scipy", reason="the confidence interval is scipy's; see requirements-benchmark.txt")
    returns = enjoy.main([str(base_run.folder / "policy.pt"), "--video-episodes", "0", "--episodes", "5"])
    text = capsys.readouterr().out
    half = 2.7764451 * returns.std(ddof=1) / np.sqrt(5)  # Student's t with 4 degrees of freedom
    assert f"return {returns.mean():.2f}, standard deviation {returns.std(ddof=1):.2f}" in text
    assert f"interval {returns.mean() - half:.2f} to {returns.mean() + half:.2f}" in text
    again = enjoy.main([str(base_run.folder), "--video-episodes", "0", "--episodes", "5", "--seed", "9"])
    assert (again != returns).any()
    means = enjoy.main([str(base_run.folder), "--video-episodes", "0", "--episodes", "5", "--mean-action"])
    assert (means != returns).any()


def test_enjoy_refuses_what_is_not_a_policy(base_run, tmp_path, capsys):
    assert "no such file" in refused(capsys, enjoy.main, [str(tmp_path)])
    assert "is no policy" in refused(capsys, enjoy.main, [str(base_run.folder / "checkpoint.pt")])
    (tmp_path / "policy.pt").write_text("nonsense")
    assert "is no policy" in refused(capsys, enjoy.main, [str(tmp_path)])
    assert "must be >= 1" in refused(capsys, enjoy.main, [str(base_run.folder), "--episodes", "0"])
