"""Batched forms of Gymnasium's own MuJoCo tasks, equal to `gym.make(id)` to the last bit.

The arithmetic follows gymnasium/envs/mujoco/*_v4.py and *_v5.py of Gymnasium 1.4: the same MuJoCo calls, and for each
number the same floating-point operations in the same order and precision. Control costs, for example, are summed in the
precision of the actions, float32 as a rule. `mj_rnePostConstraint`, which Gymnasium calls after every step, only fills
contact forces, so only the tasks that look at these call it.

Keywords and their defaults are read off the constructors of the original classes.
"""

import inspect
from typing import ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.registration import load_env_creator

from gpo_envs.models import compile_spec, load_spec
from gpo_envs.vector import RENDERING, MujocoVectorEnv


class GymnasiumVectorEnv(MujocoVectorEnv):
    """What Gymnasium's MuJoCo tasks have in common. `constants` are what v4 fixes and v5, mostly, takes as keywords."""

    @classmethod
    def keywords(cls) -> dict:
        original = load_env_creator(gym.spec(cls.env_id).entry_point)
        parameters = inspect.signature(original.__init__).parameters.values()
        return {
            parameter.name: parameter.default
            for parameter in parameters
            if parameter.default is not parameter.empty and parameter.name not in RENDERING
        }

    @property
    def frame_skip(self) -> int:
        return self.options.frame_skip

    def load_model(self) -> mujoco.MjModel:
        return compile_spec(load_spec(self.options.xml_file))

    def build_action_space(self) -> gym.spaces.Box:
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        return gym.spaces.Box(low, high, dtype=np.float32)

    def build_observation_space(self) -> gym.spaces.Box:
        size = sum(part.shape[1] for part in self.observed())
        return gym.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float64)

    def observe(self, out: np.ndarray) -> None:
        np.concatenate(self.observed(), axis=1, out=out)

    def observed(self) -> list[np.ndarray]:
        """The parts of the observation in their order, each [n, size]."""
        return [self.now.qpos[:, self.hidden() :], self.now.qvel]

    def hidden(self) -> int:
        """How many of the first positions are left out of the observation."""
        return 0

    def simulate(self, actions: np.ndarray) -> None:
        """Advance all copies under `actions` [n, nu] and look at them."""
        self.controls[:] = actions
        self.advance()
        self.gather()

    def uniform_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The model's initial state with uniform noise on positions and velocities."""
        scale = self.options.reset_noise_scale
        qpos = self.init_qpos + generator.uniform(low=-scale, high=scale, size=self.model.nq)
        return qpos, self.init_qvel + generator.uniform(low=-scale, high=scale, size=self.model.nv)

    def normal_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The model's initial state with uniform noise on positions and Gaussian noise on velocities."""
        scale = self.options.reset_noise_scale
        qpos = self.init_qpos + generator.uniform(low=-scale, high=scale, size=self.model.nq)
        return qpos, self.init_qvel + scale * generator.standard_normal(self.model.nv)

    def never(self) -> np.ndarray:
        """No episode ends, [n]."""
        return np.zeros(self.num_envs, dtype=bool)


class Runner(GymnasiumVectorEnv):
    """A robot that is paid for its speed along x and charged for its actions."""

    def hidden(self) -> int:
        return int(self.options.exclude_current_positions_from_observation)

    def control_cost(self, actions: np.ndarray) -> np.ndarray:
        """The weighted sum of squared actions, in their precision, [n]."""
        return self.options.ctrl_cost_weight * np.sum(np.square(actions), axis=1)

    def position(self) -> np.ndarray:
        """The coordinate whose speed is paid, [n]."""
        return self.now.qpos[:, 0].copy()

    def run(self, actions: np.ndarray) -> np.ndarray:
        """Advance all copies; returns the weighted speed, [n]."""
        before = self.position()
        self.simulate(actions)
        return self.options.forward_reward_weight * ((self.position() - before) / self.dt)

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.run(actions) - self.control_cost(actions), self.never()


class HalfCheetahV4(Runner):
    env_id = "HalfCheetah-v4"
    constants: ClassVar[dict] = {"xml_file": "half_cheetah.xml", "frame_skip": 5}
    draw_state = GymnasiumVectorEnv.normal_state


class HalfCheetahV5(HalfCheetahV4):
    env_id = "HalfCheetah-v5"


class SwimmerV4(Runner):
    env_id = "Swimmer-v4"
    constants: ClassVar[dict] = {"xml_file": "swimmer.xml", "frame_skip": 4}
    draw_state = GymnasiumVectorEnv.uniform_state

    def hidden(self) -> int:
        return 2 * super().hidden()


class SwimmerV5(SwimmerV4):
    env_id = "Swimmer-v5"


class Faller(Runner):
    """A runner that is also paid for staying healthy, and whose episode ends when it is not."""

    def healthy(self) -> np.ndarray:
        """Whether the robot has not fallen, [n], bool."""
        raise NotImplementedError

    def healthy_reward(self, healthy: np.ndarray) -> np.ndarray:
        """What v4 pays for health: also in the step that ends an episode, [n]."""
        return (healthy | bool(self.options.terminate_when_unhealthy)) * self.options.healthy_reward

    def cost(self, actions: np.ndarray) -> np.ndarray:
        """What is charged, [n]."""
        return self.control_cost(actions)

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        forward = self.run(actions)
        healthy = self.healthy()
        rewards = forward + self.healthy_reward(healthy) - self.cost(actions)
        return rewards, ~healthy & bool(self.options.terminate_when_unhealthy)


class PaidWhileHealthy:
    """Mixin of v5, which does not pay for health in the step that ends an episode."""

    def healthy_reward(self, healthy: np.ndarray) -> np.ndarray:
        return healthy * self.options.healthy_reward


class Walker2dV4(Faller):
    env_id = "Walker2d-v4"
    constants: ClassVar[dict] = {"xml_file": "walker2d.xml", "frame_skip": 4}
    draw_state = GymnasiumVectorEnv.uniform_state

    def healthy(self) -> np.ndarray:
        (low, high), (left, right) = self.options.healthy_z_range, self.options.healthy_angle_range
        height, angle = self.now.qpos[:, 1], self.now.qpos[:, 2]
        return (low < height) & (height < high) & (left < angle) & (angle < right)

    def observed(self) -> list[np.ndarray]:
        return [self.now.qpos[:, self.hidden() :], np.clip(self.now.qvel, -10, 10)]


class Walker2dV5(PaidWhileHealthy, Walker2dV4):
    env_id = "Walker2d-v5"


class HopperV4(Walker2dV4):
    env_id = "Hopper-v4"
    constants: ClassVar[dict] = {"xml_file": "hopper.xml", "frame_skip": 4}

    def healthy(self) -> np.ndarray:
        low, high = self.options.healthy_state_range
        state = np.concatenate([self.now.qpos[:, 2:], self.now.qvel], axis=1)
        return super().healthy() & ((low < state) & (state < high)).all(axis=1)


class HopperV5(PaidWhileHealthy, HopperV4):
    env_id = "Hopper-v5"


class AntV4(Faller):
    env_id = "Ant-v4"
    constants: ClassVar[dict] = {"frame_skip": 5, "main_body": "torso", "forward_reward_weight": 1}
    draw_state = GymnasiumVectorEnv.normal_state

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        views = {**super().views(data), "body": data.body(self.options.main_body).xpos}
        return {**views, "forces": data.cfrc_ext} if self.reads_forces() else views

    def hidden(self) -> int:
        return 2 * super().hidden()

    def position(self) -> np.ndarray:
        return self.now.body[:, 0].copy()

    def healthy(self) -> np.ndarray:
        low, high = self.options.healthy_z_range
        finite = np.isfinite(self.now.qpos).all(axis=1) & np.isfinite(self.now.qvel).all(axis=1)
        return finite & (low <= self.now.qpos[:, 2]) & (self.now.qpos[:, 2] <= high)

    def forces(self) -> np.ndarray:
        """Contact torques and forces on all bodies, the world first, clipped, [n, 6 bodies]."""
        return np.clip(self.now.forces, *self.options.contact_force_range)

    def reads_forces(self) -> bool:
        """Whether contact forces are charged for, so that they have to be computed."""
        return bool(self.options.use_contact_forces)

    def advance(self) -> None:
        super().advance()
        if self.reads_forces():
            for data in self.datas:
                mujoco.mj_rnePostConstraint(self.model, data)  # fills cfrc_ext

    def cost(self, actions: np.ndarray) -> np.ndarray:
        cost = self.control_cost(actions)
        if self.reads_forces():
            cost = cost + self.options.contact_cost_weight * np.sum(np.square(self.forces()), axis=1)
        return cost

    def observed(self) -> list[np.ndarray]:
        return super().observed() + ([self.forces()] if self.options.use_contact_forces else [])


class AntV5(PaidWhileHealthy, AntV4):
    env_id = "Ant-v5"

    def reads_forces(self) -> bool:
        return True

    def observed(self) -> list[np.ndarray]:
        forces = [self.forces()[:, 6:]] if self.options.include_cfrc_ext_in_observation else []
        return super(AntV4, self).observed() + forces


class HumanoidV4(Faller):
    env_id = "Humanoid-v4"
    constants: ClassVar[dict] = {"xml_file": "humanoid.xml", "frame_skip": 5}
    draw_state = GymnasiumVectorEnv.uniform_state

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {
            **super().views(data),
            "centers": data.xipos,
            "inertias": data.cinert,
            "velocities": data.cvel,
            "actuators": data.qfrc_actuator,
            "forces": data.cfrc_ext,
        }

    def hidden(self) -> int:
        return 2 * super().hidden()

    def advance(self) -> None:
        super().advance()
        for data in self.datas:
            mujoco.mj_rnePostConstraint(self.model, data)  # fills cfrc_ext

    def position(self) -> np.ndarray:
        # One call a copy: summed in the same order as in Gymnasium's mass_center.
        masses = self.model.body_mass
        centers = self.now.centers.reshape(self.num_envs, -1, 3)
        return np.array([np.einsum("b,bj->j", masses, center)[0] for center in centers]) / masses.sum()

    def control_cost(self, actions: np.ndarray) -> np.ndarray:
        return super().control_cost(self.controls)

    def healthy(self) -> np.ndarray:
        low, high = self.options.healthy_z_range
        return (low < self.now.qpos[:, 2]) & (self.now.qpos[:, 2] < high)

    def observed(self) -> list[np.ndarray]:
        now = self.now
        return [*super().observed(), now.inertias, now.velocities, now.actuators, now.forces]


class HumanoidV5(PaidWhileHealthy, HumanoidV4):
    env_id = "Humanoid-v5"

    def cost(self, actions: np.ndarray) -> np.ndarray:
        contact_cost = self.options.contact_cost_weight * np.sum(np.square(self.now.forces), axis=1)
        return self.control_cost(actions) + np.clip(contact_cost, *self.options.contact_cost_range)

    def observed(self) -> list[np.ndarray]:
        options, now = self.options, self.now
        parts = [  # without the world's entries, and without the free joint's forces
            (options.include_cinert_in_observation, now.inertias[:, 10:]),
            (options.include_cvel_in_observation, now.velocities[:, 6:]),
            (options.include_qfrc_actuator_in_observation, now.actuators[:, 6:]),
            (options.include_cfrc_ext_in_observation, now.forces[:, 6:]),
        ]
        return super(HumanoidV4, self).observed() + [part for included, part in parts if included]


class InvertedPendulumV4(GymnasiumVectorEnv):
    env_id = "InvertedPendulum-v4"
    constants: ClassVar[dict] = {"xml_file": "inverted_pendulum.xml", "frame_skip": 2, "reset_noise_scale": 0.01}
    draw_state = GymnasiumVectorEnv.uniform_state

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.simulate(actions)
        finite = np.isfinite(self.now.qpos).all(axis=1) & np.isfinite(self.now.qvel).all(axis=1)
        terminated = ~finite | (np.abs(self.now.qpos[:, 1]) > 0.2)
        return self.pay(terminated), terminated

    def pay(self, terminated: np.ndarray) -> np.ndarray:
        """The reward of a step, [n]."""
        return np.ones(self.num_envs)


class InvertedPendulumV5(InvertedPendulumV4):
    env_id = "InvertedPendulum-v5"

    def pay(self, terminated: np.ndarray) -> np.ndarray:
        return 1.0 - terminated


class InvertedDoublePendulumV4(GymnasiumVectorEnv):
    env_id = "InvertedDoublePendulum-v4"
    constants: ClassVar[dict] = {
        "xml_file": "inverted_double_pendulum.xml",
        "frame_skip": 5,
        "reset_noise_scale": 0.1,
        "healthy_reward": 10,
    }
    draw_state = GymnasiumVectorEnv.normal_state

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {**super().views(data), "tip": data.site_xpos[0], "constraints": data.qfrc_constraint}

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.simulate(actions)
        # The original squares NumPy scalars, which is a call of C's pow and not the product that an array's ** 2 is;
        # the two differ in the last bit of one square in a thousand. float_power calls pow.
        x, y = self.now.tip[:, 0], self.now.tip[:, 2]
        distance_penalty = 0.01 * np.float_power(x, 2) + np.float_power(y - 2, 2)
        rates = np.float_power(self.now.qvel[:, 1:3], 2)
        velocity_penalty = 1e-3 * rates[:, 0] + 5e-3 * rates[:, 1]
        terminated = y <= 1
        return self.alive_bonus(terminated) - distance_penalty - velocity_penalty, terminated

    def alive_bonus(self, terminated: np.ndarray) -> np.ndarray | float:
        """What a step pays before penalties."""
        return self.options.healthy_reward

    def observed(self) -> list[np.ndarray]:
        now = self.now
        angles, forces = now.qpos[:, 1:], np.clip(now.constraints, -10, 10)
        return [now.qpos[:, :1], np.sin(angles), np.cos(angles), np.clip(now.qvel, -10, 10), forces]


class InvertedDoublePendulumV5(InvertedDoublePendulumV4):
    env_id = "InvertedDoublePendulum-v5"

    def alive_bonus(self, terminated: np.ndarray) -> np.ndarray:
        return self.options.healthy_reward * ~terminated

    def observed(self) -> list[np.ndarray]:
        *parts, forces = super().observed()
        return [*parts, forces[:, :1]]


def norms(vectors: np.ndarray) -> np.ndarray:
    """Lengths of `vectors` [n, 3], with one call of BLAS for each, as np.linalg.norm makes it, [n]."""
    return np.sqrt([vector.dot(vector) for vector in vectors])


class ReacherV4(GymnasiumVectorEnv):
    env_id = "Reacher-v4"
    constants: ClassVar[dict] = {
        "xml_file": "reacher.xml",
        "frame_skip": 2,
        "reward_dist_weight": 1,
        "reward_control_weight": 1,
    }

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {**super().views(data), "tip": data.body("fingertip").xpos, "target": data.body("target").xpos}

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        qpos = generator.uniform(low=-0.1, high=0.1, size=self.model.nq) + self.init_qpos
        goal = generator.uniform(low=-0.2, high=0.2, size=2)
        while np.linalg.norm(goal) >= 0.2:
            goal = generator.uniform(low=-0.2, high=0.2, size=2)
        qvel = self.init_qvel + generator.uniform(low=-0.005, high=0.005, size=self.model.nv)
        qpos[-2:], qvel[-2:] = goal, 0
        return qpos, qvel

    def reward(self, actions: np.ndarray) -> np.ndarray:
        """Minus distance to the target and minus squared actions, in the current state, [n]."""
        distance_term = -norms(self.now.tip - self.now.target) * self.options.reward_dist_weight
        return distance_term + -np.square(actions).sum(axis=1) * self.options.reward_control_weight

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rewards = self.reward(actions)  # v4 pays for the state before the step
        self.simulate(actions)
        return rewards, self.never()

    def observed(self) -> list[np.ndarray]:
        qpos, qvel = self.now.qpos, self.now.qvel
        angles, gap = qpos[:, :2], self.now.tip - self.now.target
        return [np.cos(angles), np.sin(angles), qpos[:, 2:], qvel[:, :2], gap]


class ReacherV5(ReacherV4):
    env_id = "Reacher-v5"

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.simulate(actions)
        return self.reward(actions), self.never()

    def observed(self) -> list[np.ndarray]:
        *parts, gap = super().observed()
        return [*parts, gap[:, :2]]


class PusherV5(GymnasiumVectorEnv):
    """Pusher-v4 does not exist on MuJoCo 3 and later (gymnasium/envs/mujoco/pusher_v4.py)."""

    env_id = "Pusher-v5"

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        bodies = {name: data.body(name).xpos for name in ("tips_arm", "object", "goal")}
        return {**super().views(data), **bodies}

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        def draw_cylinder():
            return np.concatenate([generator.uniform(-0.3, 0, size=1), generator.uniform(-0.2, 0.2, size=1)])

        cylinder = draw_cylinder()
        while np.linalg.norm(cylinder) <= 0.17:
            cylinder = draw_cylinder()
        qpos = self.init_qpos.copy()
        qpos[-4:-2], qpos[-2:] = cylinder, 0
        qvel = self.init_qvel + generator.uniform(low=-0.005, high=0.005, size=self.model.nv)
        qvel[-4:] = 0
        return qpos, qvel

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.simulate(actions)
        options, now = self.options, self.now
        near = -norms(now.object - now.tips_arm) * options.reward_near_weight
        distance_term = -norms(now.object - now.goal) * options.reward_dist_weight
        control = -np.square(actions).sum(axis=1) * options.reward_control_weight
        return distance_term + control + near, self.never()

    def observed(self) -> list[np.ndarray]:
        now = self.now
        return [now.qpos[:, :7], now.qvel[:, :7], now.tips_arm, now.object, now.goal]


TASKS = (
    HalfCheetahV4, HalfCheetahV5,
    Walker2dV4, Walker2dV5,
    HopperV4, HopperV5,
    AntV4, AntV5,
    SwimmerV4, SwimmerV5,
    HumanoidV4, HumanoidV5,
    InvertedPendulumV4, InvertedPendulumV5,
    InvertedDoublePendulumV4, InvertedDoublePendulumV5,
    ReacherV4, ReacherV5,
    PusherV5,
)  # fmt: skip
