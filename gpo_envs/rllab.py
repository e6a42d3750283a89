"""The paper's tasks: rllab's MuJoCo environments, batched and single.

Each task is one batched class, built from Gymnasium's installed MJCF by the edits in its `edit`; its single form, for
`gym.make` and for pictures, is that class with one copy, so the two agree to the bit. Numbers and arithmetic follow
rllab at commit ba78e4c, rllab/envs/mujoco/*_env.py and vendor/mujoco_models/*.xml
(https://github.com/rll/rllab/tree/ba78e4c). What differs from it on purpose is listed in docs/environments.md.

Common to all (mujoco_env.py and normalized_env.py): actions are in [-1, 1] and scaled to the motors' range; after the
physics step everything derived from the state is brought up to date; rewards are paid per step, not per second; and
velocity is that of the whole robot's centre of mass.
"""

from typing import ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

from gpo_envs.models import compile_spec, load_spec, use_old_capsule_masses
from gpo_envs.vector import MujocoVectorEnv

EULER, RK4 = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4


class RllabVectorEnv(MujocoVectorEnv):
    """What rllab's tasks have in common.

    Keyword `legacy_masses`: capsules weigh as they did in the MuJoCo that rllab used (see `use_old_capsule_masses`).
    """

    xml_file: str
    frame_skip = 1
    root = "torso"  # the body that carries the whole robot
    observation_size: int

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None, copy: bool = True, **options):
        super().__init__(num_envs, max_episode_steps, copy, **options)
        self._motor_range = self.model.actuator_ctrlrange[:, 1].copy()
        self._actions = np.zeros((num_envs, self.model.nu))

    @classmethod
    def keywords(cls) -> dict:
        return {"legacy_masses": True}

    def load_model(self) -> mujoco.MjModel:
        spec = load_spec(self.xml_file)
        self.edit(spec)
        # The sensor makes MuJoCo compute the centre of mass's velocity in every forward pass.
        spec.add_sensor(
            name="velocity",
            type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=self.root,
        )
        model = compile_spec(spec)
        if self.options.legacy_masses:
            use_old_capsule_masses(model, spec)
        return model

    def edit(self, spec: mujoco.MjSpec) -> None:
        """Turn Gymnasium's asset into rllab's model."""
        raise NotImplementedError

    def build_action_space(self) -> gym.spaces.Box:
        return gym.spaces.Box(-1, 1, (self.model.nu,), dtype=np.float32)

    def build_observation_space(self) -> gym.spaces.Box:
        return gym.spaces.Box(-1e6, 1e6, (self.observation_size,), dtype=np.float64)

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        root = self.model.body(self.root).id
        return {
            **super().views(data),
            "center_of_mass": data.subtree_com[root],
            "velocity": data.subtree_linvel[root],
        }

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return (
            self.init_qpos + 0.01 * generator.standard_normal(self.model.nq),
            self.init_qvel + 0.1 * generator.standard_normal(self.model.nv),
        )

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        np.clip(actions, -1, 1, out=self._actions)
        np.multiply(self._actions, self._motor_range, out=self.controls)
        self.advance()
        self.gather()
        return self.reward(), self.terminated() | self.diverged()

    def advance(self) -> None:
        """Simulate `frame_skip` physics steps in every copy, then bring all derived quantities up to date.

        With Euler's integrator a step is mj_step1 (all that depends on the state alone) and mj_step2 (all that depends
        on the controls). What these tasks observe is computed by the first half, which is also the next step's first
        half: so each copy always stands between the two, at half the cost of mj_step and mj_forward, to the same bits.
        """
        model, more = self.model, self.frame_skip - 1
        if model.opt.integrator == EULER:
            mj_step, mj_step1, mj_step2 = mujoco.mj_step, mujoco.mj_step1, mujoco.mj_step2
            for data, ctrl, row in self._lanes:
                ctrl[:] = row
                mj_step2(model, data)
                if more:
                    mj_step(model, data, more)
                mj_step1(model, data)
        else:
            super().advance()
            for data in self.datas:
                self.settle(data)

    def reward(self) -> np.ndarray:
        """The reward of the step just made, [n]."""
        raise NotImplementedError

    def terminated(self) -> np.ndarray:
        """Whether the episode ends in the current state, [n], bool."""
        return np.zeros(self.num_envs, dtype=bool)

    def control_cost(self, weight: float) -> np.ndarray:
        """`weight` times the sum of squared actions, [n]."""
        return weight * np.sum(np.square(self._actions), axis=1)


class HalfCheetah(RllabVectorEnv):
    """half_cheetah_env.py: run as fast as possible; no episode ends early."""

    env_id = "rllab/HalfCheetah-v0"
    xml_file = "half_cheetah.xml"
    observation_size = 20

    def edit(self, spec: mujoco.MjSpec) -> None:
        """Gymnasium's asset is rllab's."""

    def reward(self) -> np.ndarray:
        return self.now.velocity[:, 0] - self.control_cost(0.05)

    def observe(self, out: np.ndarray) -> None:
        out[:, :8] = self.now.qpos[:, 1:]
        out[:, 8:17] = self.now.qvel
        out[:, 17:] = self.now.center_of_mass


class RllabEnv(gym.Env):
    """One copy of a task, for `gym.make`, pictures and films.

    Args:
        render_mode: None, "human", "rgb_array" or "depth_array"; the camera follows the robot.
        width, height: size of the picture in pixels.
        options: the task's keywords.
    """

    metadata: ClassVar[dict] = {"render_modes": ["human", "rgb_array", "depth_array"]}
    task: type[RllabVectorEnv]

    def __init__(self, render_mode: str | None = None, width: int = 480, height: int = 480, **options):
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be one of {self.metadata['render_modes']}, got {render_mode!r}")
        self._copies = self.task(num_envs=1, max_episode_steps=-1, **options)
        self.model, self.data, self.dt = self._copies.model, self._copies.datas[0], self._copies.dt
        self.action_space = self._copies.single_action_space
        self.observation_space = self._copies.single_observation_space
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}
        self.render_mode = render_mode
        screen = self.model.vis.global_
        screen.offwidth, screen.offheight = max(screen.offwidth, width), max(screen.offheight, height)
        follow = {"trackbodyid": self.model.body(self.task.root).id, "distance": 4.0}
        self._renderer = MujocoRenderer(self.model, self.data, follow, width, height, camera_name="track")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Start a new episode; returns its first observation [d] and an empty info."""
        super().reset(seed=seed)
        self._copies.restart(0, self.np_random)
        self._copies.gather()
        if self.render_mode == "human":
            self.render()
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Advance by one step under `action` [action_dim]; info has `diverged` if MuJoCo's state did.

        Raises:
            ValueError: if the action has another shape.
        """
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"expected an action of shape {self.action_space.shape}, got {action.shape}")
        rewards, terminations = self._copies.transition(action[None])
        info = {"diverged": True} if self._copies.diverged()[0] else {}
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(rewards[0]), bool(terminations[0]), False, info

    def render(self) -> np.ndarray | None:
        """The current picture: [height, width, 3] uint8, or depth [height, width] float32; None on the screen."""
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode; pass one to gym.make")
            return None
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        self._renderer.close()

    def _observation(self) -> np.ndarray:
        observations = np.zeros((1, self._copies.observation_size))
        self._copies.observe(observations)
        return observations[0]


class HalfCheetahEnv(RllabEnv):
    task = HalfCheetah


TASKS = (HalfCheetahEnv,)
