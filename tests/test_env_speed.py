"""The benchmark of stepping."""

import csv
import os

from benchmark import env_speed


def test_benchmark_writes_rates_and_circumstances(tmp_path, capsys):
    cores = os.sched_getaffinity(0)
    out = tmp_path / "speed.csv"
    ways = ["bare", "gpo_envs", "sync", "rollout"]
    argv = ["--env-ids", "Hopper-v5", "rllab/Swimmer-v0", "--ways", *ways, "--num-envs", "2", "--out", str(out)]
    try:
        env_speed.main([*argv, "--rounds", "1", "--seconds", "0.01"])
    finally:
        os.sched_setaffinity(0, cores)
    rows = list(csv.DictReader(out.open()))
    assert [row["env_id"] for row in rows] == ["Hopper-v5", "rllab/Swimmer-v0"]
    printed = capsys.readouterr().out
    for row in rows:
        assert all(int(row[way]) > 0 for way in ways)
        assert 0 < float(row["gpo_envs/bare"]) < 10
        assert row["mujoco_version"].count(".") == 2
        assert row["gpo_envs"] in printed
