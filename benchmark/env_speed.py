"""How fast are environments stepped? Compares the ways of stepping each task that `gpo_envs` serves.

    python -m benchmark.env_speed                          # all tasks, about five minutes
    python -m benchmark.env_speed --env-ids Hopper-v4 rllab/Hopper-v0 --rounds 9

One round steps each way in turn for the same number of steps; the table has medians over rounds. Ways that stay in the
calling thread are timed in that thread's CPU seconds, so that other load on the machine does not count; AsyncVectorEnv
and EnvPool by the wall clock. All have the cores given by --cores:

- bare: nothing but `mj_step` (and `mj_forward` for rllab's tasks, whose observations need it), called from Python on
  the recorded states and controls of our run, whose writing into the simulator is not timed. No observation, no reward,
  no reset: what is left for a Python program that keeps one MjData per environment.
- gpo_envs: `gym.make_vec` with this package imported.
- sync, async: Gymnasium's SyncVectorEnv and AsyncVectorEnv.
- envpool: EnvPool with one thread, if it is installed and has the task.
- rollout: `mujoco.rollout` on the calling thread, one call for each environment step, from the recorded states. It has
  no observation, reward or reset either, nor rllab's forward pass.

All but bare and rollout see the same random actions; EnvPool draws its own initial states.
"""

import argparse
import csv
import importlib.metadata
import os
import platform
import time
import warnings
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from mujoco.rollout import Rollout

from gpo_envs import gymnasium_tasks, rllab

try:
    import envpool
except ImportError:
    envpool = None

WAYS = ("bare", "gpo_envs", "sync", "async", "envpool", "rollout")
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
ALL_IDS = [task.env_id for task in gymnasium_tasks.TASKS] + [env.task.env_id for env in rllab.TASKS]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-ids", nargs="+", default=ALL_IDS, metavar="ID")
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--seconds", type=float, default=0.08, help="length of one way's part of a round, about")
    parser.add_argument("--cores", type=int, default=1, help="how many cores everything may use")
    parser.add_argument("--out", type=Path, default=Path("results/env_speed/env_speed.csv"))
    args = parser.parse_args(argv)

    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-args.cores :])
    warnings.filterwarnings("ignore", message=".*out of date.*")
    if envpool is None and "envpool" in args.ways:
        print("EnvPool is not installed, its column stays empty: pip install envpool")
    print(f"{'environment steps per second':36}" + "".join(f"{way:>10}" for way in args.ways) + f"{'ours/bare':>11}")
    rows = []
    for env_id in args.env_ids:
        rows.append(measure(env_id, args))
        rates = "".join(f"{rows[-1][way]:>10}" for way in args.ways)
        print(f"{env_id:36}{rates}{rows[-1]['gpo_envs/bare']:>11}", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"written to {args.out}")


def measure(env_id: str, args: argparse.Namespace) -> dict:
    """One row of the table: environment steps per second of each way, and what they were measured on."""
    ours = gym.make_vec(env_id, num_envs=args.num_envs)
    space = ours.single_action_space
    generator = np.random.default_rng(0)
    size = (max(2, int(args.seconds / seconds_per_step(ours))), args.num_envs, *space.shape)
    actions = generator.uniform(space.low, space.high, size).astype(np.float32)

    makers = {
        "bare": lambda: bare_timer(ours, actions),
        "gpo_envs": lambda: env_timer(ours, actions, time.thread_time),
        "sync": lambda: env_timer(gymnasium_vector(env_id, args.num_envs, "sync"), actions, time.thread_time),
        "async": lambda: env_timer(gymnasium_vector(env_id, args.num_envs, "async"), actions, time.perf_counter),
        "envpool": lambda: envpool_timer(env_id, actions),
        "rollout": lambda: rollout_timer(ours, actions),
    }
    timers = {way: timer for way in args.ways if (timer := makers[way]()) is not None}
    seconds = {way: [] for way in timers}
    for _ in range(args.rounds):
        for way, timer in timers.items():
            seconds[way].append(timer())
    steps = actions.shape[0] * args.num_envs
    rates = {way: round(steps / np.median(seconds[way])) if way in seconds else "" for way in args.ways}
    ratio = ""
    if {"bare", "gpo_envs"} <= set(timers):
        ratio = f"{np.median(np.divide(seconds['bare'], seconds['gpo_envs'])):.2f}"
    return {"env_id": env_id, **rates, "gpo_envs/bare": ratio, "num_envs": args.num_envs, **circumstances(args)}


def seconds_per_step(env: gym.vector.VectorEnv) -> float:
    """How long one step of all copies takes, roughly."""
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    start = time.perf_counter()
    for _ in range(10):
        env.step(actions)
    return (time.perf_counter() - start) / 10


def env_timer(env: gym.vector.VectorEnv, actions: np.ndarray, clock):
    """Returns a function that steps `env` through all `actions` and returns the seconds that took by `clock`."""

    def timer() -> float:
        env.reset(seed=0)
        start = clock()
        for action in actions:
            env.step(action)
        return clock() - start

    return timer


def gymnasium_vector(env_id: str, num_envs: int, mode: str) -> gym.vector.VectorEnv:
    """Gymnasium's own vectorization."""
    autoreset = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode=mode, vector_kwargs=autoreset)


def envpool_timer(env_id: str, actions: np.ndarray):
    """As `env_timer`, for EnvPool with one thread; None where it does not have the task."""
    if envpool is None or env_id not in envpool.list_all_envs():
        return None
    env = envpool.make(env_id, env_type="gymnasium", num_envs=actions.shape[1], num_threads=1, seed=0)
    double = actions.astype(np.float64)

    def timer() -> float:
        env.reset()
        start = time.perf_counter()
        for action in double:
            env.step(action)
        return time.perf_counter() - start

    return timer


def record(env: gym.vector.VectorEnv, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The states [steps, n, size] that `env` steps from under `actions`, and its controls [steps, n, nu]."""
    size = mujoco.mj_stateSize(env.model, STATE)
    states, controls = np.zeros((*actions.shape[:2], size)), np.zeros((*actions.shape[:2], env.model.nu))
    env.reset(seed=0)
    for step, action in enumerate(actions):
        for data, state in zip(env.datas, states[step], strict=True):
            mujoco.mj_getState(env.model, data, state, STATE)
        env.step(action)
        controls[step] = env.controls
    return states, controls


def bare_timer(env: gym.vector.VectorEnv, actions: np.ndarray):
    """As `env_timer`, for MuJoCo alone on the states of `env`."""
    model, frame_skip, forward = env.model, env.frame_skip, isinstance(env, rllab.RllabVectorEnv)
    states, controls = record(env, actions)
    datas = [mujoco.MjData(model) for _ in range(env.num_envs)]

    def timer() -> float:
        seconds = 0.0
        for step_states, step_controls in zip(states, controls, strict=True):
            for data, state, control in zip(datas, step_states, step_controls, strict=True):
                mujoco.mj_setState(model, data, state, STATE)
                data.ctrl[:] = control
            start = time.thread_time()
            for data in datas:
                mujoco.mj_step(model, data, frame_skip)
                if forward:
                    mujoco.mj_forward(model, data)
            seconds += time.thread_time() - start
        return seconds

    return timer


def rollout_timer(env: gym.vector.VectorEnv, actions: np.ndarray):
    """As `env_timer`, for `mujoco.rollout` from the states of `env`."""
    states, controls = record(env, actions)
    rollout, data = Rollout(nthread=0), mujoco.MjData(env.model)
    physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
    size = mujoco.mj_stateSize(env.model, physics)
    starts = np.zeros((*states.shape[:2], size))
    for recorded, start in zip(states.reshape(-1, states.shape[-1]), starts.reshape(-1, size), strict=True):
        mujoco.mj_setState(env.model, data, recorded, STATE)
        mujoco.mj_getState(env.model, data, start, physics)
    held = np.repeat(controls[:, :, None], env.frame_skip, axis=2)

    def timer() -> float:
        start = time.thread_time()
        for initial, control in zip(starts, held, strict=True):
            rollout.rollout(env.model, data, initial, control)
        return time.thread_time() - start

    return timer


def circumstances(args: argparse.Namespace) -> dict:
    """Versions and hardware."""
    cpu = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    versions = {name: importlib.metadata.version(name) for name in ("mujoco", "gymnasium", "numpy")}
    versions["envpool"] = envpool.__version__ if envpool else ""
    versions = {f"{name}_version": version for name, version in versions.items()}
    return {
        "cores": args.cores,
        "of_cores": os.cpu_count(),
        "cpu": cpu,
        "python": platform.python_version(),
        **versions,
    }


if __name__ == "__main__":
    main()
