"""Draws the pictures of docs/environments.md.

    MUJOCO_GL=egl python -m benchmark.render_envs        # needs no screen

Each task is shown under a gentle random policy; the hilly ones also at three difficulties, seen from further away.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import imageio.v3
import mujoco
import numpy as np

from gpo_envs import rllab

DIFFICULTIES = (0.3, 1.0, 2.0)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    for task in (env.task for env in rllab.TASKS):
        name = task.env_id.removeprefix("rllab/").removesuffix("-v0")
        imageio.v3.imwrite(args.out / f"{name}.png", frame(task.env_id, steps=12))
    hilly = [env.task.env_id for env in rllab.TASKS if issubclass(env.task, rllab.Hills)]
    sheet = [[landscape(env_id, difficulty) for difficulty in DIFFICULTIES] for env_id in hilly]
    imageio.v3.imwrite(args.out / "hills.png", np.concatenate([np.concatenate(row, axis=1) for row in sheet]))


def frame(env_id: str, steps: int, width: int = 320, height: int = 240) -> np.ndarray:
    """The picture after some steps, [height, width, 3], uint8."""
    env = gym.make(env_id, render_mode="rgb_array", width=width, height=height)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(steps):
        _, _, terminated, _, _ = env.step(generator.uniform(-0.3, 0.3, env.action_space.shape))
        if terminated:
            break
    picture = env.render()
    env.close()
    return picture


def landscape(env_id: str, difficulty: float, width: int = 300, height: int = 180) -> np.ndarray:
    """The robot at its start and the hills ahead of it, [height, width, 3], uint8."""
    env = gym.make(env_id, difficulty=difficulty).unwrapped
    env.reset(seed=0)
    floor = env.model.geom("floor")
    floor.matid, floor.rgba = -1, [0.5, 0.65, 0.45, 1]  # the chequered floor hides the shapes
    env.model.light_dir[0] = 0.6, 0.3, -0.6
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 3.5, 0, 0.5
    camera.distance, camera.azimuth, camera.elevation = 8, 80, -12
    with mujoco.Renderer(env.model, height, width) as renderer:
        renderer.update_scene(env.data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # speckled over a field of this size
        return renderer.render()


if __name__ == "__main__":
    main()
