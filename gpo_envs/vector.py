"""Many copies of one MuJoCo task, stepped one after the other in the calling thread.

`MujocoVectorEnv` is the whole mechanism. A task is a subclass that says how its model is built, which parts of the
simulator's memory it looks at, how a state is drawn, and what reward, termination and observation are, each for all
copies at once. There is one `MjModel`, one `MjData` per copy, and no thread or process: scripts that want more cores
start more ranks.
"""

from numbers import Integral
from types import SimpleNamespace
from typing import ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

# The counters that MuJoCo raises when it found a state or an acceleration that is NaN or huge, after which it puts the
# copy back to the model's initial state. They stand side by side in mjtWarning.
DIVERGENCE = slice(mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQACC + 1)

RENDERING = (
    "render_mode",
    "width",
    "height",
    "camera_id",
    "camera_name",
    "default_camera_config",
    "max_geom",
    "visual_options",
)


class MujocoVectorEnv(gym.vector.VectorEnv):
    """Base of all batched tasks.

    Autoreset is SAME_STEP: where an episode ends, the returned observation is the first one of the next episode, and
    the last one of the ended episode is in `infos["final_obs"]`, an object array as `SyncVectorEnv` returns it, with
    its mask `infos["_final_obs"]`. When MuJoCo found a copy's state diverging, `infos["diverged"]` (bool, [n], with its
    mask `infos["_diverged"]`) marks it until that copy is reset; without a divergence the key is absent. The terms of
    the reward, which the single environments put into `info`, are not returned.

    Args:
        num_envs: number of copies, n.
        max_episode_steps: steps after which an episode is truncated; None is the id's own limit and -1 none, as in
            `gym.make`.
        copy: whether `reset` and `step` return a fresh array of observations (the default) or a buffer that the next
            call overwrites. Rewards, terminations, truncations and `final_obs` are always fresh.
        options: the task's own keywords.

    Raises:
        TypeError: for a keyword that the task does not have.
        ValueError: for a number of copies or a limit that is not positive.
    """

    metadata: ClassVar[dict] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    env_id: str  # the registered id whose batched form this is
    frame_skip: int  # physics steps per environment step
    constants: ClassVar[dict] = {}  # options that are no keywords of the task

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None, copy: bool = True, **options):
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if max_episode_steps is None:
            max_episode_steps = gym.spec(self.env_id).max_episode_steps
        elif max_episode_steps < 1 and max_episode_steps != -1:
            raise ValueError(f"max_episode_steps must be positive, or -1 for no limit, got {max_episode_steps}")
        self.num_envs = num_envs
        self.copy = copy
        self.render_mode = None
        self.options = SimpleNamespace(**{**self.constants, **self._checked(options)})

        self.model = self.load_model()
        self.dt = self.model.opt.timestep * self.frame_skip
        self.datas = [mujoco.MjData(self.model) for _ in range(num_envs)]
        self.init_qpos = self.datas[0].qpos.copy()
        self.init_qvel = self.datas[0].qvel.copy()
        self._mirror_memory()

        self.single_action_space = self.build_action_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.single_observation_space = self.build_observation_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._limit = np.iinfo(np.int64).max if max_episode_steps == -1 else max_episode_steps
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._observations = np.zeros(self.observation_space.shape)
        self._generators = [None] * num_envs

    # ---- what a task says -------------------------------------------------------------------------------------------

    @classmethod
    def keywords(cls) -> dict:
        """The task's keywords with their defaults."""
        raise NotImplementedError

    def load_model(self) -> mujoco.MjModel:
        """The compiled model, shared by all copies."""
        raise NotImplementedError

    def build_action_space(self) -> gym.spaces.Box:
        """The actions of one copy."""
        raise NotImplementedError

    def build_observation_space(self) -> gym.spaces.Box:
        """The observations of one copy, float64."""
        raise NotImplementedError

    def views(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """The arrays of one copy's memory that the task looks at; `self.now.<name>` has them for all, [n, size]."""
        return {"qpos": data.qpos, "qvel": data.qvel}

    def draw_state(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A random initial state: positions [nq] and velocities [nv]."""
        raise NotImplementedError

    def transition(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance all copies under `actions` [n, action_dim]; returns rewards [n] and terminations [n], bool."""
        raise NotImplementedError

    def observe(self, out: np.ndarray) -> None:
        """Write the observations of the current states into `out` [n, d]."""
        raise NotImplementedError

    # ---- the simulator's memory -------------------------------------------------------------------------------------

    def _mirror_memory(self) -> None:
        """Set up the buffers that `gather` fills from all copies with one call.

        Every attribute access on an MjData makes a new array object, so the views are taken once.
        """
        views = [{name: view.reshape(-1) for name, view in self.views(data).items()} for data in self.datas]
        self._sources = [view for copy in views for view in copy.values()]
        ends = np.cumsum([view.size for view in views[0].values()])
        mirror = np.zeros((self.num_envs, ends[-1]))
        self._mirror = mirror.reshape(-1)
        columns = zip(views[0], ends, strict=True)
        self.now = SimpleNamespace(**{name: mirror[:, end - views[0][name].size : end] for name, end in columns})

        self._warning_sources = [data.warning.number[DIVERGENCE] for data in self.datas]
        self._warnings = np.zeros((self.num_envs, self._warning_sources[0].size), dtype=self._warning_sources[0].dtype)
        self._warnings_flat = self._warnings.reshape(-1)

        self.controls = np.zeros((self.num_envs, self.model.nu))
        self._lanes = [(data, data.ctrl, row) for data, row in zip(self.datas, self.controls, strict=True)]

    def gather(self) -> None:
        """Copy what the task looks at from all copies into `self.now`."""
        np.concatenate(self._sources, out=self._mirror)

    def advance(self) -> None:
        """Apply `self.controls` [n, nu] and simulate `frame_skip` physics steps in every copy."""
        model, frame_skip, mj_step = self.model, self.frame_skip, mujoco.mj_step
        for data, ctrl, row in self._lanes:
            ctrl[:] = row
            mj_step(model, data, frame_skip)

    def settle(self, data: mujoco.MjData) -> None:
        """Compute everything that follows from a state just written into `data`."""
        mujoco.mj_forward(self.model, data)

    def restart(self, index: int, generator: np.random.Generator) -> None:
        """Put copy `index` into a newly drawn state."""
        data = self.datas[index]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:], data.qvel[:] = self.draw_state(generator)
        self.settle(data)

    def diverged(self) -> np.ndarray | None:
        """Which copies MuJoCo found diverging since their last reset, [n], bool; None, as a rule, if there are none."""
        np.concatenate(self._warning_sources, out=self._warnings_flat)
        return self._warnings.any(axis=1) if self._warnings_flat.any() else None

    # ---- Gymnasium's interface --------------------------------------------------------------------------------------

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Start new episodes in all copies, or in those of `options["reset_mask"]` (bool, [n]).

        Args:
            seed: copy i is seeded with seed + i, or with the i-th entry of a list, just as `gym.make(id).reset(seed)`
                seeds; None leaves a generator where it stands.
            options: only `reset_mask` is read.

        Returns:
            Observations [n, d], float64, and an empty info.

        Raises:
            ValueError: if the seeds are not n, or the mask has another shape or is nowhere True.
            TypeError: if the mask is not a boolean array.
        """
        if seed is None or isinstance(seed, Integral):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"expected one seed for each of the {self.num_envs} copies, got {len(seeds)}")
        for index in self._masked((options or {}).get("reset_mask")):
            if seeds[index] is not None or self._generators[index] is None:
                self._generators[index], _ = seeding.np_random(seeds[index])
            self.restart(index, self._generators[index])
            self._elapsed[index] = 0
        self.gather()
        self.observe(self._observations)
        return self._returned_observations(), {}

    def step(self, actions: np.ndarray):
        """Advance every copy by one environment step.

        Args:
            actions: [n, action_dim], in the units of `single_action_space`; clipping to it is the caller's part.

        Returns:
            Observations [n, d], float64; rewards [n], float64; terminations [n] and truncations [n], bool; infos as in
            the class's docstring.

        Raises:
            ValueError: if the actions have another shape.
            gymnasium.error.ResetNeeded: before the first `reset`.
        """
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"expected actions of shape {self.action_space.shape}, got {actions.shape}")
        if None in self._generators:
            raise gym.error.ResetNeeded("call reset() before step()")
        rewards, terminations = self.transition(actions)
        self.observe(self._observations)
        self._elapsed += 1
        truncations = self._elapsed >= self._limit

        infos = {}
        diverged = self.diverged()
        if diverged is not None:
            infos["diverged"], infos["_diverged"] = diverged, diverged.copy()
        ended = terminations | truncations
        if ended.any():
            infos["final_obs"], infos["_final_obs"] = self._restart_ended(ended), ended
        return self._returned_observations(), rewards, terminations, truncations, infos

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The generators of the copies."""
        return tuple(self._generators)

    def _restart_ended(self, ended: np.ndarray) -> np.ndarray:
        """Reset the copies in the mask `ended` [n]; returns their last observations as an object array [n]."""
        last = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended):
            last[index] = self._observations[index].copy()
            self.restart(index, self._generators[index])
            self._elapsed[index] = 0
        self.gather()
        self.observe(self._observations)
        return last

    def _returned_observations(self) -> np.ndarray:
        return self._observations.copy() if self.copy else self._observations

    def _masked(self, mask: np.ndarray | None) -> np.ndarray:
        """The indices of the copies that a reset concerns."""
        if mask is None:
            return np.arange(self.num_envs)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a boolean NumPy array, got {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},) and a True entry, got {mask}")
        return np.flatnonzero(mask)

    @classmethod
    def _checked(cls, options: dict) -> dict:
        """The task's keywords, defaults filled in; refuses unknown ones by name."""
        known = cls.keywords()
        for name in options:
            if name in RENDERING:
                raise TypeError(
                    f"the batched form of {cls.env_id} does not draw, so it takes no {name!r}: "
                    f"use gym.make, or make_vec with vectorization_mode='sync'"
                )
            if name not in known:
                raise TypeError(f"{cls.env_id} takes no keyword {name!r}; it takes {', '.join(known) or 'none'}")
        return {**known, **options}
