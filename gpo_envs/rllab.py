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
from gpo_envs.terrain import add_terrain, hills
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
        terminated, diverged = self.terminated(), self.diverged()
        return self.reward(), terminated if diverged is None else terminated | diverged

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


class Walker2d(RllabVectorEnv):
    """walker2d_env.py: walk; an episode ends when the torso falls or tips over. Positions start z, x, pitch."""

    env_id = "rllab/Walker2d-v0"
    xml_file = "walker2d.xml"
    observation_size = 21

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.timestep, spec.option.integrator = 0.005, EULER
        swap_root_slides(spec)
        set_motors(spec, [150, 100, 100, 150, 100, 100])

    def reward(self) -> np.ndarray:
        return self.now.velocity[:, 0] - self.control_cost(0.005)

    def terminated(self) -> np.ndarray:
        height, pitch = self.now.qpos[:, 0], self.now.qpos[:, 2]
        return ~((0.8 < height) & (height < 2.0) & (-1.0 < pitch) & (pitch < 1.0))

    def observe(self, out: np.ndarray) -> None:
        out[:, :9] = self.now.qpos
        out[:, 9:18] = self.now.qvel
        out[:, 18:] = self.now.center_of_mass


class Hopper(RllabVectorEnv):
    """hopper_env.py: hop, paid 1 a step for not falling. Positions start z, x, pitch."""

    env_id = "rllab/Hopper-v0"
    xml_file = "hopper.xml"
    observation_size = 20

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.timestep, spec.option.integrator = 0.02, RK4
        swap_root_slides(spec)
        set_motors(spec, [200, 200, 200])

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {**super().views(data), "constraint_forces": data.qfrc_constraint}

    def reward(self) -> np.ndarray:
        return self.now.velocity[:, 0] + 1 - self.control_cost(0.005)

    def terminated(self) -> np.ndarray:
        qpos, qvel = self.now.qpos, self.now.qvel
        bounded = (np.abs(qpos[:, 3:]) < 100).all(axis=1) & (np.abs(qvel) < 100).all(axis=1)
        upright = (qpos[:, 0] > 0.7) & (np.abs(qpos[:, 2]) < 0.2)
        return ~(bounded & upright & np.isfinite(qpos).all(axis=1))

    def observe(self, out: np.ndarray) -> None:
        out[:, 0] = self.now.qpos[:, 0]
        out[:, 1:5] = self.now.qpos[:, 2:]
        np.clip(self.now.qvel, -10, 10, out=out[:, 5:11])
        np.clip(self.now.constraint_forces, -10, 10, out=out[:, 11:17])
        out[:, 17:] = self.now.center_of_mass


class InvertedDoublePendulum(RllabVectorEnv):
    """inverted_double_pendulum_env.py: keep two poles upright on a cart, paid 10 a step."""

    env_id = "rllab/InvertedDoublePendulum-v0"
    xml_file = "inverted_double_pendulum.xml"
    frame_skip = 2
    root = "cart"
    observation_size = 11

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.joint("slider").range = [-10, 10]
        # The only asset without a light, and without a camera that follows the robot.
        spec.worldbody.add_light(pos=[0, -1, 3], dir=[0, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        spec.body("cart").add_camera(
            name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=[0, -3, 0.5], quat=[0.7071, 0.7071, 0, 0]
        )

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {**super().views(data), "tip": data.site_xpos[0], "constraint_forces": data.qfrc_constraint}

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        angle = np.deg2rad(40) * (generator.random() - 0.5)
        return np.array([0, angle, 0]), np.zeros(3)

    def reward(self) -> np.ndarray:
        x, y = self.now.tip[:, 0], self.now.tip[:, 2]
        rate, rate2 = self.now.qvel[:, 1], self.now.qvel[:, 2]
        return 10 - 0.01 * x**2 - (y - 2) ** 2 - 1e-3 * rate**2 - 5e-3 * rate2**2

    def terminated(self) -> np.ndarray:
        return self.now.tip[:, 2] <= 1

    def observe(self, out: np.ndarray) -> None:
        out[:, 0] = self.now.qpos[:, 0]
        np.sin(self.now.qpos[:, 1:], out=out[:, 1:3])
        np.cos(self.now.qpos[:, 1:], out=out[:, 3:5])
        np.clip(self.now.qvel, -10, 10, out=out[:, 5:8])
        np.clip(self.now.constraint_forces, -10, 10, out=out[:, 8:])


class Swimmer(RllabVectorEnv):
    """swimmer_env.py: swim along x in the plane; no episode ends early. The position is part of the observation."""

    env_id = "rllab/Swimmer-v0"
    xml_file = "swimmer.xml"
    frame_skip = 50
    observation_size = 13

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.timestep, spec.option.integrator = 0.001, EULER
        spec.option.iterations = 1000
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        for joint in spec.joints:
            joint.armature = 0
        set_motors(spec, [50, 50])

    def reward(self) -> np.ndarray:
        return self.now.velocity[:, 0] - self.control_cost(0.005)

    def observe(self, out: np.ndarray) -> None:
        out[:, :5] = self.now.qpos
        out[:, 5:10] = self.now.qvel
        out[:, 10:] = self.now.center_of_mass


class Ant(RllabVectorEnv):
    """ant_env.py: walk on four legs, with the contact forces on every body in view."""

    env_id = "rllab/Ant-v0"
    xml_file = "ant.xml"
    observation_size = 125

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None, copy: bool = True, **options):
        super().__init__(num_envs, max_episode_steps, copy, **options)
        self.init_qpos = self.model.numeric("init_qpos").data.copy()  # crouching, as Gymnasium's Ant does not

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.timestep = 0.02
        for geom in spec.geoms:
            geom.solimp[:3] = [0.8, 0.8, 0.01]
        set_motors(spec, [150] * 8)

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        orientation = data.xmat[self.model.body(self.root).id]
        return {**super().views(data), "contact_forces": data.cfrc_ext, "orientation": orientation}

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel = super().draw_state(generator)
        qpos[3:7] /= np.linalg.norm(qpos[3:7])  # MuJoCo 1.31 did this in place
        return qpos, qvel

    def settle(self, data: mujoco.MjData) -> None:
        super().settle(data)
        mujoco.mj_rnePostConstraint(self.model, data)  # fills cfrc_ext, which mj_forward has not since MuJoCo 2.0

    def reward(self) -> np.ndarray:
        contact_cost = 0.5e-3 * np.sum(np.square(self.clipped_forces()), axis=1)
        return self.now.velocity[:, 0] - self.control_cost(0.005) - contact_cost + 0.05

    def terminated(self) -> np.ndarray:
        height = self.now.qpos[:, 2]
        finite = np.isfinite(self.now.qpos).all(axis=1) & np.isfinite(self.now.qvel).all(axis=1)
        return ~(finite & (0.2 <= height) & (height <= 1.0))

    def observe(self, out: np.ndarray) -> None:
        out[:, :15] = self.now.qpos
        out[:, 15:29] = self.now.qvel
        out[:, 29:113] = self.clipped_forces()
        out[:, 113:122] = self.now.orientation
        out[:, 122:] = self.now.center_of_mass

    def clipped_forces(self) -> np.ndarray:
        """Torque and force of the contacts on each of the 14 bodies, the world first, clipped to [-1, 1], [n, 84]."""
        return np.clip(self.now.contact_forces, -1, 1)


class Hills:
    """Mixin: the same robot, reward and observation on a landscape of hills, which the robot does not see.

    Keywords `difficulty`, the height of the highest hills in metres, at least 0.05, and `terrain_seed`, the landscape.
    """

    @classmethod
    def keywords(cls) -> dict:
        return {**super().keywords(), "difficulty": 1.0, "terrain_seed": 0}

    def edit(self, spec: mujoco.MjSpec) -> None:
        super().edit(spec)
        add_terrain(spec, self.options.difficulty)

    def load_model(self) -> mujoco.MjModel:
        model = super().load_model()
        # Written here because the compiler would stretch a landscape to fill the full range of heights.
        model.hfield_data[:] = hills(self.options.terrain_seed).ravel()
        return model


class HalfCheetahHilly(Hills, HalfCheetah):
    env_id = "rllab/HalfCheetahHilly-v0"


class Walker2dHilly(Hills, Walker2d):
    env_id = "rllab/Walker2dHilly-v0"


class HopperHilly(Hills, Hopper):
    env_id = "rllab/HopperHilly-v0"


def swap_root_slides(spec: mujoco.MjSpec) -> None:
    """Put the root's height before its x position, the order of rllab's walker and hopper."""
    first, second = spec.joint("rootx"), spec.joint("rootz")
    first.axis, second.axis = second.axis.copy(), first.axis.copy()
    first.ref, second.ref = second.ref, first.ref
    first.name, second.name = "swapped", "rootx"
    first.name = "rootz"


def set_motors(spec: mujoco.MjSpec, torques: list[float]) -> None:
    """Let the controls be torques in N m, limited to `torques`, one for each motor."""
    for motor, torque in zip(spec.actuators, torques, strict=True):
        motor.gear[0] = 1
        motor.ctrlrange = [-torque, torque]


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
        info = {} if self._copies.diverged() is None else {"diverged": True}
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


class Walker2dEnv(RllabEnv):
    task = Walker2d


class HopperEnv(RllabEnv):
    task = Hopper


class InvertedDoublePendulumEnv(RllabEnv):
    task = InvertedDoublePendulum


class SwimmerEnv(RllabEnv):
    task = Swimmer


class AntEnv(RllabEnv):
    task = Ant


class HalfCheetahHillyEnv(RllabEnv):
    task = HalfCheetahHilly


class Walker2dHillyEnv(RllabEnv):
    task = Walker2dHilly


class HopperHillyEnv(RllabEnv):
    task = HopperHilly


TASKS = (
    HalfCheetahEnv,
    Walker2dEnv,
    HopperEnv,
    InvertedDoublePendulumEnv,
    SwimmerEnv,
    AntEnv,
    HalfCheetahHillyEnv,
    Walker2dHillyEnv,
    HopperHillyEnv,
)
