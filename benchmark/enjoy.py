"""Plays the best policy of a run: returns with their confidence interval, a video, a window.

With the defaults it meets the run's own report episodes, so it prints the return that the run's evaluation.json reports.
Videos need requirements-benchmark.txt, and on a machine without a screen MUJOCO_GL=egl (or osmesa).
Example: python -m benchmark.enjoy runs/HalfCheetah-v4__gpo_ppo__1__1700000000
"""

import json
import os
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
import tyro

import gpo_ppo

PURPOSE = "report"  # names the stream of random numbers: that of the episodes that a run reports at its end
KEYS = {"format", "flags", "max_episode_steps", "policy", "sizes", "mean", "inv_std", "id", "report_return"}


@dataclass
class Args:
    run: tyro.conf.Positional[Path]
    """the folder of a finished run of any of the scripts, or a policy.pt"""
    seed: int | None = None
    """the seed of starts and of action noise; default: the run's"""
    episodes: int | None = None
    """how many episodes to evaluate; default: as many as the run reported"""
    mean_action: bool = False
    """whether to act by the Gaussian's mean instead of sampling from it"""
    video_episodes: int = 1
    """how many of these episodes to record, each as an mp4 (at most 20)"""
    output: Path | None = None
    """the folder for the videos; default: videos/ beside policy.pt"""
    render: bool = False
    """whether to show these episodes in a window instead of recording them"""


def load_policy(path):
    """A policy.pt, or the one in a run's folder: the flags as a script has them, the policy as a stack of one, statistics."""
    path = path / "policy.pt" if path.is_dir() else path
    if not path.is_file():
        gpo_ppo.refuse(f"{path}: there is no such file; a run writes it at its end")
    try:
        saved = torch.load(path, weights_only=True)
        if not KEYS <= set(saved) or saved["format"] != 1:
            raise ValueError("other content")
    except Exception as error:
        reason = " ".join(str(error).split())[:100]
        gpo_ppo.refuse(f"{path}: is no policy of these scripts ({type(error).__name__}: {reason})")
    args = SimpleNamespace(**saved["flags"])
    args.max_episode_steps = saved["max_episode_steps"]
    gpo_ppo.check_environment(args)
    if list(gpo_ppo.policy_sizes(args)) != saved["sizes"]:
        gpo_ppo.refuse(f"{path}: layers {saved['sizes']} do not fit {args.env_id}, which needs {gpo_ppo.policy_sizes(args)}")
    stats = SimpleNamespace(mean=saved["mean"].numpy()[None], inv_std=saved["inv_std"].numpy()[None])
    return args, gpo_ppo.make_policy(saved["policy"][None], args), stats, saved


def summary(returns, confidence=0.95):
    """Mean, standard deviation of the returns [episodes], and Student's confidence interval of the mean (low, high)."""
    from scipy import stats  # here, so that a policy can be loaded without it

    mean, deviation = returns.mean(), returns.std(ddof=1) if len(returns) > 1 else 0.0
    if deviation == 0:
        return mean, deviation, (mean, mean)
    return mean, deviation, stats.t.interval(confidence, len(returns) - 1, mean, stats.sem(returns))


def play(args, env, policy, stats, episodes, shown, mean_action):
    """Returns of the first `shown` of the episodes that `evaluate` plays, in one environment, step by step.

    The policy sees as many copies of the observation as `evaluate` has environments, because a product of matrices may
    round differently for another number of columns.
    """
    width, space, returns = min(episodes, 20), env.action_space, []
    seeds = gpo_ppo.env_seeds(width, args.seed, PURPOSE, 0)
    noise = gpo_ppo.normal_noise([gpo_ppo.rng(args.seed, PURPOSE, 0, 1)], args.max_episode_steps, width, args.act_dim)
    act = gpo_ppo.sample_actions(policy, stats, None if mean_action else noise)
    for k in range(min(shown, width)):
        obs, _ = env.reset(seed=seeds[k])
        total, done, t = 0.0, False, 0
        while not done:
            action = act(np.tile(np.asarray(obs, np.float32).reshape(-1), (width, 1)), t)[k]
            action = np.clip(action, space.low.reshape(-1), space.high.reshape(-1)).reshape(space.shape)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, done, t = total + reward, terminated or truncated, t + 1
        returns.append(total)
    return returns


def open_environment(args, folder):
    """One environment that records every episode into the folder, or shows it in a window if the folder is None."""
    mode = "human" if folder is None else "rgb_array"
    env = gym.make(args.env_id, render_mode=mode, max_episode_steps=args.max_episode_steps, **json.loads(args.env_kwargs))
    if folder is None:
        return env
    return gym.wrappers.RecordVideo(env, str(folder), episode_trigger=lambda _: True, name_prefix="policy")


def main(argv=None):
    """Evaluates, prints, records or shows; returns the returns [episodes]."""
    options = tyro.cli(Args, args=argv, description=__doc__)
    args, policy, stats, saved = load_policy(options.run)
    args.seed = args.seed if options.seed is None else options.seed
    episodes = args.report_episodes if options.episodes is None else options.episodes
    for flag, value, least in (
        ("episodes", episodes, 1),
        ("video-episodes", options.video_episodes, 0),
        ("seed", args.seed, 0),
    ):
        if value < least:
            gpo_ppo.refuse(f"--{flag} {value}: must be >= {least}")
    torch.set_num_threads(1)
    with torch.no_grad():
        returns = gpo_ppo.evaluate(args, policy, stats, PURPOSE, episodes, options.mean_action)[0]
        mean, deviation, (low, high) = summary(returns)
        how = "mean actions" if options.mean_action else "sampled actions"
        print(f"{args.env_id}, policy {saved['id']}, {episodes} episodes of at most {args.max_episode_steps} steps, {how}")
        print(f"return {mean:.2f}, standard deviation {deviation:.2f}, 95 % confidence interval {low:.2f} to {high:.2f}")
        if not options.video_episodes:
            return returns
        beside = options.run if options.run.is_dir() else options.run.parent
        if options.render and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
            gpo_ppo.refuse("--render: there is no screen here; leave the flag out to record a video")
        folder = None if options.render else options.output or beside / "videos"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of v4 tasks' age, and of a video that is written over
                env = open_environment(args, folder)
                shown = play(args, env, policy, stats, episodes, options.video_episodes, options.mean_action)
                env.close()
        except gym.error.DependencyNotInstalled as error:
            gpo_ppo.refuse(f"{error}; pip install -r requirements-benchmark.txt, or --video-episodes 0")
        except Exception as error:  # what a missing screen raises depends on the library that draws
            hint = "a window needs a screen" if options.render else "without a screen set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
            gpo_ppo.refuse(f"{args.env_id} cannot be drawn here ({' '.join(str(error).split())}); {hint}")
    for k, total in enumerate(shown):
        where = "shown" if options.render else folder / f"policy-episode-{k}.mp4"
        print(f"episode {k}: return {total:.2f}, {where}")
    return returns


if __name__ == "__main__":
    main()
