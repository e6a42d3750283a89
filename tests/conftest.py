"""What the tests of the scripts share: flags without a command line, tiny runs, and an environment with a known answer."""

import json
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import gpo_ppo

torch.set_num_threads(1)  # as in training; threads on these small nets wait for each other

# One generation of Pendulum takes about half a second with these.
TINY = {
    "env_id": "Pendulum-v1",
    "population": 2,
    "num_steps": 64,
    "num_envs": 2,
    "max_episode_steps": 64,
    "rounds": 2,
    "total_timesteps": 1600,
    "expert_steps": 100,
    "student_steps": 20,
    "dagger_iterations": 1,
    "dagger_epochs": 1,
    "pi_s_epochs": 1,
    "critic_epochs": 2,
    "comparison_episodes": 1,
    "selection_episodes": 2,
    "report_episodes": 3,
    "workers": 1,
}


class Line(gym.Env):
    """A point on a line that should stay at 0: x <- x + 0.2 action, reward -|x|; far out (|x| > 2) it terminates.

    The observation [[x, 1], [x/2, -1]] and the action [[a]] are not flat.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1, 1), np.float32)

    def __init__(self, start=1.0):
        self.start = start

    def observe(self):
        return np.array([[self.x, 1], [self.x / 2, -1]])

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(0.5, 1) * self.np_random.choice([-1, 1]) * self.start
        return self.observe(), {}

    def step(self, action):
        assert action.shape == (1, 1) and abs(action) <= 1
        self.x += 0.2 * float(action[0, 0])
        return self.observe(), -abs(self.x), abs(self.x) > 2, False, {}


gym.register("gpo_test/Line-v0", Line, max_episode_steps=32)


def flags(**values):
    """Flags as a command line's words."""
    words = []
    for name, value in values.items():
        flag = name.replace("_", "-")
        words += [f"--{'' if value else 'no-'}{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    return words


@pytest.fixture(scope="session")
def tiny():
    """tiny(run_dir, **changes): the command line of a run that takes about a second."""
    return lambda run_dir, **changes: flags(**{**TINY, "run_dir": run_dir, **changes})


@pytest.fixture(scope="session")
def make_args():
    """make_args(**changes): the defaults of all flags in one namespace, as `parse_args` gives them."""

    def make(**changes):
        args = SimpleNamespace(obs_dim=5, act_dim=2, plan=[3, 3])
        for group in fields(gpo_ppo.Args):
            vars(args).update(vars(group.type()))
        vars(args).update(changes)
        return args

    return make


def read_run(folder):
    """What a run left in its folder."""
    folder = Path(folder)
    return SimpleNamespace(
        folder=folder,
        evaluation=json.loads((folder / "evaluation.json").read_text()),
        lineage=[json.loads(line) for line in (folder / "lineage.jsonl").read_text().splitlines()],
        checkpoint=torch.load(folder / "checkpoint.pt", weights_only=True),
        args=json.loads((folder / "args.json").read_text()),
    )


@pytest.fixture(scope="session")
def train(tiny):
    """train(run_dir, **changes): a tiny run in this process; returns what it left in its folder."""

    def train(run_dir, **changes):
        name = changes.setdefault("run_name", "run")
        result = gpo_ppo.main(tiny(run_dir, **changes))
        run = read_run(Path(run_dir) / name)
        assert run.evaluation == result
        return run

    return train


@pytest.fixture(scope="session")
def base_run(train, tmp_path_factory):
    """Three members, two rounds, one worker: the run that others must equal."""
    return train(tmp_path_factory.mktemp("base"), population=3, total_timesteps=2400)


@pytest.fixture(scope="session")
def assert_same_run():
    """Two runs ended with the same numbers, to the bit: evaluation, lineage, and all that a checkpoint holds."""

    def check(a, b):
        assert (a.folder / "evaluation.json").read_bytes() == (b.folder / "evaluation.json").read_bytes()
        assert (a.folder / "lineage.jsonl").read_bytes() == (b.folder / "lineage.jsonl").read_bytes()
        assert a.checkpoint["population"].keys() == b.checkpoint["population"].keys()
        for name, stack in a.checkpoint["population"].items():
            assert torch.equal(stack, b.checkpoint["population"][name]), name

    return check
