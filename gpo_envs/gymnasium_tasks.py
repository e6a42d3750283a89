"""Batched forms of Gymnasium's own MuJoCo tasks, equal to `gym.make(id)` to the last bit.

The arithmetic follows gymnasium/envs/mujoco/*_v4.py and *_v5.py of Gymnasium 1.4: the same MuJoCo calls, and for each
number the same floating-point operations in the same order and precision. Control costs, for example, are summed in the
precision of the actions, float32 as a rule. `mj_rnePostConstraint`, which Gymnasium calls after every step, only fills
contact forces, so only the tasks that look at these call it.

Keywords and their defaults are read off the constructors of the original classes.
"""

import inspect

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.registration import load_env_creator

from gpo_envs.models import compile_spec, load_spec
from gpo_envs.vector import RENDERING, MujocoVectorEnv


class GymnasiumVectorEnv(MujocoVectorEnv):
    """What Gymnasium's MuJoCo tasks have in common."""

    xml_file: str  # v4 fixes the model and the number of physics steps that v5 takes as keywords

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None, copy: bool = True, **options):
        self.frame_skip = self._checked(options).get("frame_skip", self.frame_skip)
        super().__init__(num_envs, max_episode_steps, copy, **options)

    @classmethod
    def keywords(cls) -> dict:
        original = load_env_creator(gym.spec(cls.env_id).entry_point)
        parameters = inspect.signature(original.__init__).parameters.values()
        return {
            parameter.name: parameter.default
            for parameter in parameters
            if parameter.default is not parameter.empty and parameter.name not in RENDERING
        }

    def load_model(self) -> mujoco.MjModel:
        return compile_spec(load_spec(getattr(self.options, "xml_file", self.xml_file)))

    def build_action_space(self) -> gym.spaces.Box:
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        return gym.spaces.Box(low, high, dtype=np.float32)

    def build_observation_space(self) -> gym.spaces.Box:
        return gym.spaces.Box(-np.inf, np.inf, (self.observation_size(),), dtype=np.float64)

    def observation_size(self) -> int:
        """Length of one copy's observation; here that of positions and velocities without the hidden coordinates."""
        return self.model.nq + self.model.nv - self.hidden()

    def hidden(self) -> int:
        """How many of the first positions are left out of the observation."""
        return 0

    def observe(self, out: np.ndarray) -> None:
        hidden, positions = self.hidden(), self.model.nq - self.hidden()
        out[:, :positions] = self.now.qpos[:, hidden:]
        out[:, positions:] = self.now.qvel

    def simulate(self, actions: np.ndarray) -> None:
        """Advance all copies under `actions` [n, nu] and look at them."""
        self.controls[:] = actions
        self.advance()
        self.gather()

    def uniform(self, generator: np.random.Generator, start: np.ndarray, scale: float) -> np.ndarray:
        """`start` plus uniform noise in [-scale, scale)."""
        return start + generator.uniform(low=-scale, high=scale, size=start.size)

    def normal(self, generator: np.random.Generator, start: np.ndarray, scale: float) -> np.ndarray:
        """`start` plus Gaussian noise of standard deviation `scale`."""
        return start + scale * generator.standard_normal(start.size)

    def never(self) -> np.ndarray:
        """Nobody terminates."""
        return np.zeros(self.num_envs, dtype=bool)


class Runner(GymnasiumVectorEnv):
    """A robot that is paid for the speed of its first coordinate and charged for its actions."""

    def hidden(self) -> int:
        return int(self.options.exclude_current_positions_from_observation)

    def control_cost(self, actions: np.ndarray) -> np.ndarray:
        """The weighted sum of squared actions, in their precision, [n]."""
        return self.options.ctrl_cost_weight * np.sum(np.square(actions), axis=1)

    def run(self, actions: np.ndarray) -> np.ndarray:
        """Advance all copies; returns the weighted speed along x, [n]."""
        before = self.now.qpos[:, 0].copy()
        self.simulate(actions)
        return self.options.forward_reward_weight * ((self.now.qpos[:, 0] - before) / self.dt)


class HalfCheetahV4(Runner):
    env_id = "HalfCheetah-v4"
    xml_file, frame_skip = "half_cheetah.xml", 5

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        scale = self.options.reset_noise_scale
        return self.uniform(generator, self.init_qpos, scale), self.normal(generator, self.init_qvel, scale)

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.run(actions) - self.control_cost(actions), self.never()


class HalfCheetahV5(HalfCheetahV4):
    env_id = "HalfCheetah-v5"
