"""rllab's tasks: models, observations, rewards, ends and hills, against numbers from outside the package."""

import os
import warnings

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, env_render_passive_checker

from gpo_envs import rllab, terrain

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date.*:DeprecationWarning")

IDS = [env.task.env_id for env in rllab.TASKS]
FLAT_IDS, HILLY_IDS = IDS[:6], IDS[6:]


def make(env_id, **keywords):
    return gym.make(env_id, **keywords).unwrapped


def put(env, qpos, qvel):
    """Put a single environment into a state."""
    mujoco.mj_resetData(env.model, env.data)
    env.data.qpos[:], env.data.qvel[:] = qpos, qvel
    env._copies.settle(env.data)


def random_actions(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


# ---- the two forms ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_check_env_has_nothing_to_say(env_id):
    env = make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_single_and_batched_agree_to_the_bit(env_id):
    copies = 3
    batch = gym.make_vec(env_id, num_envs=copies, max_episode_steps=60)
    singles = [gym.make(env_id, max_episode_steps=60) for _ in range(copies)]
    observations, _ = batch.reset(seed=2)
    for i, env in enumerate(singles):
        np.testing.assert_array_equal(observations[i], env.reset(seed=2 + i)[0])
    ends = 0
    for actions in random_actions(batch, 200):
        observations, rewards, terminations, truncations, infos = batch.step(1.2 * actions)  # beyond the Box, too
        for i, env in enumerate(singles):
            observation, reward, terminated, truncated, _ = env.step(1.2 * actions[i])
            assert (reward, terminated, truncated) == (rewards[i], terminations[i], truncations[i])
            if terminated or truncated:
                ends += 1
                np.testing.assert_array_equal(infos["final_obs"][i], observation)
                observation, _ = env.reset()
            np.testing.assert_array_equal(observations[i], observation)
    assert ends >= 9


@pytest.mark.parametrize("env_id", IDS)
def test_steps_are_mj_step_and_mj_forward(env_id):
    """The halves of a step that `advance` makes give the bits of MuJoCo's whole step and a forward pass."""
    env = make(env_id)
    model, data = env.model, mujoco.MjData(env.model)
    env.reset(seed=1)
    data.qpos[:], data.qvel[:] = env.data.qpos, env.data.qvel
    for action in random_actions(env, 60):
        env.step(action)
        data.ctrl[:] = action.astype(np.float64) * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data, env.task.frame_skip)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        for name in ("qpos", "qvel", "subtree_com", "subtree_linvel", "xmat", "site_xpos"):
            np.testing.assert_array_equal(getattr(data, name), getattr(env.data, name), err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("render_mode", ["rgb_array", "depth_array"])
def test_all_pictures(env_id, render_mode):
    check_picture(env_id, render_mode)


@pytest.mark.parametrize(
    ("env_id", "render_mode"),
    [("rllab/InvertedDoublePendulum-v0", "rgb_array"), ("rllab/HopperHilly-v0", "depth_array")],
)
def test_pictures(env_id, render_mode):
    check_picture(env_id, render_mode)


def check_picture(env_id, render_mode):
    env = make(env_id, render_mode=render_mode, width=96, height=64)
    env.reset(seed=0)
    try:
        picture = env.render()
    except Exception as error:
        pytest.skip(f"no OpenGL for pictures without a screen: {error}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_render_passive_checker(env)
    assert picture.shape[:2] == (64, 96)
    assert picture.std() > 0
    env.close()
    env.close()


def test_the_camera_follows_the_robot():
    env = make("rllab/HalfCheetah-v0", render_mode="rgb_array", width=96, height=96)
    env.reset(seed=0)
    try:
        env.render()
    except Exception as error:
        pytest.skip(f"no OpenGL for pictures without a screen: {error}")

    def robot_pixels(x):
        qpos = np.zeros(9)
        qpos[0] = x
        put(env, qpos, np.zeros(9))
        red, green, blue = env.render().astype(int).transpose(2, 0, 1)
        return ((red > green + 20) & (green > blue + 20)).sum()  # the robots are orange

    assert robot_pixels(0) > 50
    assert robot_pixels(15) == pytest.approx(robot_pixels(0), rel=0.2)
    env.close()


def test_a_wrong_render_mode_is_named():
    with pytest.raises(ValueError, match="'human', 'rgb_array', 'depth_array'"):
        rllab.HopperEnv(render_mode="ansi")


def test_a_single_environment_reports_divergence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of its warnings
    env = make("rllab/HalfCheetah-v0")
    env.reset(seed=0)
    assert env.step(np.zeros(6))[4] == {}
    env.data.qvel[:] = 1e12
    _, _, terminated, _, info = env.step(np.zeros(6))
    assert terminated
    assert info == {"diverged": True}


def test_a_wrong_action_is_named():
    env = make("rllab/Hopper-v0")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\), got \(6,\)"):
        env.step(np.zeros(6))


def test_hilly_keywords_reach_both_forms():
    options = {"difficulty": 0.3, "terrain_seed": 5, "legacy_masses": False}
    single, batch = make("rllab/HopperHilly-v0", **options), gym.make_vec("rllab/HopperHilly-v0", num_envs=2, **options)
    for model in (single.model, batch.model):
        assert model.hfield_size[0, 2] == 0.3
        assert model.body("torso").mass == pytest.approx(3.665191)
        np.testing.assert_array_equal(model.hfield_data, terrain.hills(5).ravel().astype(np.float32))
    with pytest.raises(TypeError, match="'slope'"):
        gym.make("rllab/HopperHilly-v0", slope=2)


# ---- models -------------------------------------------------------------------------------------------------------

# Mass, Ixx and Izz of the bodies under MuJoCo 4 and under the old capsules.
MASSES = {
    "rllab/HalfCheetah-v0": {
        "torso": (6.250209, 6.360313, None, None, None, None),
        "bthigh": (1.543515, 1.535248, 0.0168443, 0.0152558, 0.0015760, 0.0016243),
        "bshin": (1.587448, 1.580940, 0.0182674, 0.0166083, 0.0016225, 0.0016726),
        "bfoot": (1.095397, 1.069191, 0.0063524, 0.0054443, 0.0011019, 0.0011312),
        "fthigh": (1.438075, 1.425587, 0.0137396, 0.0123185, 0.0014645, 0.0015083),
        "fshin": (1.200837, 1.178851, 0.0082221, 0.0071627, 0.0012135, 0.0012472),
        "ffoot": (0.884519, 0.849869, 0.0035291, 0.0028998, 0.0008788, 0.0008992),
    },
    "rllab/Walker2d-v0": {
        "torso": (3.665191, 3.534292, 0.0692459, 0.0618501, 0.0044506, 0.0044179),
        "thigh_left": (4.057891, 3.926991, 0.0932988, 0.0842667, 0.0049415, 0.0049087),
        "leg": (2.781357, 2.714336, 0.0723025, 0.0670441, 0.0021822, 0.0021715),
        "foot": (3.166725, 2.940531, 0.0239977, 0.0192115, 0.0053744, 0.0052930),
    },
    "rllab/Hopper-v0": {
        "torso": (3.665191, 3.534292, 0.0692459, 0.0618501, 0.0044506, 0.0044179),
        "foot": (5.315575, 5.089380, 0.1035231, 0.0904637, 0.0092423, 0.0091609),
    },
    "rllab/InvertedDoublePendulum-v0": {
        "cart": (10.471976, 9.424778, 0.1267109, 0.0942478, 0.0481711, 0.0471239),
        "pole2": (4.198739, 4.103313, 0.1549707, 0.1443340, 0.0041739, 0.0041546),
    },
    "rllab/Swimmer-v0": {"mid": (35.604717, 34.557519, 3.917566, 3.570944, 0.1738348, 0.1727876)},
    "rllab/Ant-v0": {
        "torso": (0.327249, 0.327249, 0.0081812, 0.0081812, 0.0081812, 0.0081812),
        "aux_1": (0.039158, 0.036477, 0.000568, 0.0004586, 0.0001184, 0.0001167),
    },
}
TOTALS = {
    "rllab/HalfCheetah-v0": (14, 14),
    "rllab/Walker2d-v0": (23.6771, 22.6980),
    "rllab/Hopper-v0": (15.8200, 15.2650),
    "rllab/InvertedDoublePendulum-v0": (18.8695, 17.6314),
    "rllab/Swimmer-v0": (106.814, 103.673),
    "rllab/Ant-v0": (0.91088, 0.87871),
}


@pytest.mark.parametrize("env_id", FLAT_IDS)
@pytest.mark.parametrize("legacy", [False, True])
def test_masses_and_inertias(env_id, legacy):
    model = make(env_id, **({} if legacy else {"legacy_masses": False})).model  # the old ones are the default
    assert model.body_mass.sum() == pytest.approx(TOTALS[env_id][legacy], rel=1e-5)
    assert model.body_subtreemass[0] == pytest.approx(TOTALS[env_id][legacy], rel=1e-5)  # mj_setConst was called
    for name, numbers in MASSES[env_id].items():
        body = model.body(name)
        assert body.mass == pytest.approx(numbers[legacy], rel=1e-5)
        for axis, (exact, old) in ((0, numbers[2:4]), (2, numbers[4:6])):
            if exact is not None:
                assert body.inertia[axis] == pytest.approx(old if legacy else exact, rel=1e-3)


def test_the_cheetahs_torso_with_old_masses():
    body = make("rllab/HalfCheetah-v0").model.body("torso")
    np.testing.assert_allclose(body.ipos, [0.149138, 0, 0.024856], atol=1e-6)
    np.testing.assert_allclose(body.inertia, [0.894454, 0.883565, 0.017618], atol=1e-6)


# env_id: dt, integrator, motors' range, then dimensions of observation and action.
DIFFERENCES = {
    "rllab/HalfCheetah-v0": (0.01, "EULER", [1] * 6, 20, 6),
    "rllab/Walker2d-v0": (0.005, "EULER", [150, 100, 100, 150, 100, 100], 21, 6),
    "rllab/Hopper-v0": (0.02, "RK4", [200] * 3, 20, 3),
    "rllab/InvertedDoublePendulum-v0": (0.02, "RK4", [1], 11, 1),
    "rllab/Swimmer-v0": (0.05, "EULER", [50] * 2, 13, 2),
    "rllab/Ant-v0": (0.02, "RK4", [150] * 8, 125, 8),
}


@pytest.mark.parametrize("env_id", FLAT_IDS)
def test_what_differs_from_gymnasium(env_id):
    dt, integrator, motors, observation_size, action_size = DIFFERENCES[env_id]
    env = make(env_id)
    assert env.dt == pytest.approx(dt)
    assert env.metadata["render_fps"] == round(1 / dt)
    assert mujoco.mjtIntegrator(env.model.opt.integrator) == getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    np.testing.assert_array_equal(env.model.actuator_ctrlrange, [[-motor, motor] for motor in motors])
    assert env.observation_space == gym.spaces.Box(-1e6, 1e6, (observation_size,), dtype=np.float64)
    assert env.action_space == gym.spaces.Box(-1, 1, (action_size,), dtype=np.float32)
    assert gym.spec(env_id).max_episode_steps == 512
    # Peak torques: Gymnasium's gears and rllab's ranges agree but for the walker's thighs and the swimmer.
    theirs = gym.make(env_id.replace("rllab/", "").replace("-v0", "-v4"), disable_env_checker=True).unwrapped.model
    ratio = {"rllab/Walker2d-v0": [1.5, 1, 1, 1.5, 1, 1], "rllab/Swimmer-v0": [1 / 3] * 2}.get(
        env_id, [1] * len(motors)
    )
    ours, other = (model.actuator_gear[:, 0] * model.actuator_ctrlrange[:, 1] for model in (env.model, theirs))
    np.testing.assert_allclose(ours, other * ratio)


def test_model_edits():
    assert make("rllab/InvertedDoublePendulum-v0").model.joint("slider").range.tolist() == [-10, 10]
    swimmer = make("rllab/Swimmer-v0").model
    assert not swimmer.dof_armature.any()
    assert swimmer.opt.iterations == 1000
    assert swimmer.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART
    ant = make("rllab/Ant-v0").model
    np.testing.assert_array_equal(ant.geom_solimp, np.tile([0.8, 0.8, 0.01, 0.5, 2], (ant.ngeom, 1)))
    for name in ("Walker2d", "Hopper"):
        model = make(f"rllab/{name}-v0").model
        assert [model.joint(i).name for i in range(3)] == ["rootz", "rootx", "rooty"]
        assert model.jnt_axis[:3].tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
        assert model.qpos0[:3].tolist() == [1.25, 0, 0]
    walker = make("rllab/Walker2d-v0").model
    assert (walker.geom("foot_geom").friction[0], walker.geom("foot_left_geom").friction[0]) == (0.9, 1.9)


# ---- behaviour ----------------------------------------------------------------------------------------------------

# Positions and velocity along x after 10 steps at half torque from the noise-free start, and the centre of mass there;
# exact masses. Measured once with rllab's own XML files, loaded into MuJoCo 4.0.0.
PROBES = {
    "rllab/HalfCheetah-v0": ([0.037768, 0, 0.551028], [0.053731, -0.075099, -0.109139], 0.0021997),
    "rllab/Walker2d-v0": ([0.026749, 0, 0.585261], [1.21273, 0.011198, 0.031303], -0.056624),
    "rllab/Hopper-v0": ([0.021840, 0, 0.596351], [1.25262, 0.113766, 0.164793], 0.319314),
    "rllab/InvertedDoublePendulum-v0": ([0, 0, 0.267018], [0.406593, -0.807372, 0.852284], None),
    "rllab/Swimmer-v0": ([0, 0, 0], [0.023574, 0.248765, -0.308657, 0.308664, 0.308655], -3.765e-4),
    "rllab/Ant-v0": ([0, 0, 0.479355], [0.051864, 0.000782, 0.574833], 0.295021),
}


@pytest.mark.parametrize("env_id", FLAT_IDS)
def test_probes(env_id):
    center_of_mass, qpos, speed = PROBES[env_id]
    env = make(env_id, legacy_masses=False)
    env.reset(seed=0)
    put(env, env._copies.init_qpos, 0)
    root = env.model.body(env.task.root).id
    np.testing.assert_allclose(env.data.subtree_com[root], center_of_mass, atol=1e-6)
    for _ in range(10):
        observation = env.step(np.full(env.action_space.shape, 0.5, dtype=np.float32))[0]
    np.testing.assert_allclose(env.data.qpos[: len(qpos)], qpos, atol=5e-6)
    if speed is not None:
        assert env.data.subtree_linvel[root, 0] == pytest.approx(speed, rel=1e-4)
        np.testing.assert_array_equal(observation[-3:], env.data.subtree_com[root])


# Mean return and length of episodes of at most 500 steps under uniformly random actions, exact masses, with tolerances
# of about three standard errors of the two samples. The swimmer's is no measurement: it has no preferred direction, so
# that only the cost of its actions is left, 500 x 0.005 x 2 / 3.
RANDOM_POLICY = {
    "rllab/HalfCheetah-v0": (-87, 25, 500, 0),
    "rllab/Walker2d-v0": (-0.9, 1.5, 33, 5),
    "rllab/Hopper-v0": (7.4, 1.5, 7.4, 1),
    "rllab/InvertedDoublePendulum-v0": (150, 15, 16.4, 1.5),
    "rllab/Ant-v0": (0, 35, 400, 60),
    "rllab/Swimmer-v0": (-1.67, 3.6, 500, 0),
}


@pytest.mark.parametrize(
    "env_id",
    [pytest.param(env_id, marks=[pytest.mark.slow] * (env_id == "rllab/Swimmer-v0")) for env_id in RANDOM_POLICY],
)
def test_random_policy(env_id):
    expected_return, return_tolerance, expected_length, length_tolerance = RANDOM_POLICY[env_id]
    copies = 24
    env = gym.make_vec(env_id, num_envs=copies, max_episode_steps=500, legacy_masses=False)
    env = gym.wrappers.vector.RecordEpisodeStatistics(env)
    env.reset(seed=0)
    returns, lengths = [], []
    for actions in random_actions(env, 500):
        *_, infos = env.step(actions)
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert np.mean(returns) == pytest.approx(expected_return, abs=return_tolerance)
    assert np.mean(lengths) == pytest.approx(expected_length, abs=length_tolerance)


def momentum_over_mass(env):
    """The robot's velocity along x from its bodies' own velocities."""
    model, data = env.model, env.data
    momentum, velocity = 0, np.zeros(6)
    for body in range(1, model.nbody):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        momentum += model.body_mass[body] * velocity[3]
    return momentum / model.body_mass.sum()


def state(env):
    return env.data.qpos.copy(), env.data.qvel.copy()


def expected_step(env, action):
    """Observation, reward and end of an episode, written out task by task from the state after a step."""
    name = env.spec.name.removesuffix("Hilly")
    qpos, qvel = state(env)
    mujoco.mj_forward(env.model, env.data)
    com = env.data.subtree_com[1]
    cost = sum(float(component) ** 2 for component in np.clip(action, -1, 1))
    clip = lambda values: [min(max(value, -10), 10) for value in values]  # noqa: E731
    constraints = env.data.qfrc_constraint
    if name == "HalfCheetah":
        return [*qpos[1:], *qvel, *com], momentum_over_mass(env) - 0.05 * cost, False
    if name == "Walker2d":
        fallen = not (0.8 < qpos[0] < 2.0 and -1.0 < qpos[2] < 1.0)
        return [*qpos, *qvel, *com], momentum_over_mass(env) - 0.005 * cost, fallen
    if name == "Hopper":
        fallen = not (qpos[0] > 0.7 and abs(qpos[2]) < 0.2 and max(abs(np.r_[qpos[3:], qvel])) < 100)
        observation = [qpos[0], *qpos[2:], *clip(qvel), *clip(constraints), *com]
        return observation, momentum_over_mass(env) + 1 - 0.005 * cost, fallen
    if name == "InvertedDoublePendulum":
        x, _, y = env.data.site("tip").xpos
        reward = 10 - 0.01 * x**2 - (y - 2) ** 2 - 0.001 * qvel[1] ** 2 - 0.005 * qvel[2] ** 2
        return [qpos[0], *np.sin(qpos[1:]), *np.cos(qpos[1:]), *clip(qvel), *clip(constraints)], reward, y <= 1
    if name == "Swimmer":
        return [*qpos, *qvel, *com], momentum_over_mass(env) - 0.005 * cost, False
    mujoco.mj_rnePostConstraint(env.model, env.data)
    forces = [min(max(force, -1), 1) for force in env.data.cfrc_ext.ravel()]
    reward = momentum_over_mass(env) - 0.005 * cost - 0.0005 * sum(force**2 for force in forces) + 0.05
    return [*qpos, *qvel, *forces, *env.data.xmat[1], *com], reward, not 0.2 <= qpos[2] <= 1.0


@pytest.mark.parametrize("env_id", IDS)
def test_observations_rewards_and_ends_by_hand(env_id):
    env = make(env_id)
    env.reset(seed=3)
    forces_seen = 0
    for action in 1.5 * random_actions(env, 60):
        observation, reward, terminated, truncated, _ = env.step(action)
        expected_observation, expected_reward, expected_end = expected_step(env, action)
        np.testing.assert_allclose(observation, expected_observation, rtol=1e-9, atol=1e-9)
        assert reward == pytest.approx(expected_reward, abs=1e-9)
        assert (terminated, truncated) == (expected_end, False)
        forces_seen += np.abs(env.data.cfrc_ext).sum()
        if terminated:
            env.reset()
    assert forces_seen > 0 or env_id != "rllab/Ant-v0"


@pytest.mark.parametrize(
    ("env_id", "index", "inside", "outside"),
    [
        ("rllab/Walker2d-v0", 0, (0.85, 1.95), (0.75, 2.05)),
        ("rllab/Walker2d-v0", 2, (-0.9, 0.9), (-1.1, 1.1)),
        ("rllab/Hopper-v0", 0, (1.25, 50), (0.65,)),
        ("rllab/Hopper-v0", 2, (-0.15, 0.15), (-0.25, 0.25)),
        ("rllab/Ant-v0", 2, (0.25, 0.95), (0.1, 1.1)),
    ],
)
def test_where_episodes_end(env_id, index, inside, outside):
    env = make(env_id)
    env.reset(seed=0)
    for values, expected in ((inside, False), (outside, True)):
        for value in values:
            qpos = env._copies.init_qpos.copy()
            qpos[index] = value
            if env_id == "rllab/Hopper-v0" and value < 0.7:
                qpos[3:5] = -1.2, -2.4  # folded, so that the ground does not push it up
            put(env, qpos, 0)
            assert env.step(np.zeros(env.action_space.shape))[2] == expected, value


def test_a_fast_hopper_has_ended():
    env = make("rllab/Hopper-v0")
    env.reset(seed=0)
    for speed, expected in ((50, False), (150, True)):
        put(env, env._copies.init_qpos, np.array([0, speed, 0, 0, 0, 0]))
        assert env.step(np.zeros(3))[2] == expected


@pytest.mark.parametrize("env_id", FLAT_IDS)
def test_resets(env_id):
    env = make(env_id)
    states = []
    for seed in range(200):
        env.reset(seed=seed)
        states.append(np.concatenate(state(env)))
    states, nq = np.array(states), env.model.nq
    start = {"rllab/Ant-v0": [0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1]}.get(env_id, env.model.qpos0)
    if env_id == "rllab/InvertedDoublePendulum-v0":
        angles = np.rad2deg(states[:, 1])
        assert -20 <= angles.min() < -18 and 18 < angles.max() <= 20
        assert not np.delete(states, 1, axis=1).any()
        return
    np.testing.assert_allclose(states[:, :nq].mean(axis=0), start, atol=0.004)
    spread = states.std(axis=0)
    free = np.arange(len(spread)) != 3 if env_id == "rllab/Ant-v0" else slice(None)  # the quaternion's length is 1
    np.testing.assert_allclose((spread / np.r_[np.full(nq, 0.01), np.full(env.model.nv, 0.1)])[free], 1, atol=0.25)
    if env_id == "rllab/Ant-v0":
        np.testing.assert_allclose(np.linalg.norm(states[:, 3:7], axis=1), 1)


# ---- hills --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def landscapes():
    return np.array([terrain.hills(seed).astype(np.float32) for seed in range(100)])


def test_hills_have_the_papers_statistics(landscapes):
    cell = 2 * terrain.RADIUS / (terrain.CELLS - 1)
    numbers = []
    for heights in landscapes:
        slopes = np.abs(np.diff(heights, axis=1)) / cell
        numbers.append(
            [
                *(heights.max(), heights.mean(), np.median(heights), np.percentile(heights, 95), (heights == 0).mean()),
                *(slopes.mean(), *np.percentile(slopes, [95, 99]), slopes.max()),
            ]
        )
        assert np.percentile(heights, 5) == 0
    # measured on rllab's pictures, in metres at difficulty 1
    paper = [0.96, 0.30, 0.25, 0.71, 0.07, 0.185, 0.49, 0.65, 1.2]
    np.testing.assert_allclose(np.mean(numbers, axis=0), paper, rtol=0.2)


def test_hills_are_seeded():
    np.testing.assert_array_equal(terrain.hills(3), terrain.hills(3))
    assert (terrain.hills(3) != terrain.hills(4)).mean() > 0.5
    default, same, other = (
        make("rllab/HopperHilly-v0", **options).model.hfield_data
        for options in ({}, {"terrain_seed": 0}, {"terrain_seed": 1})
    )
    np.testing.assert_array_equal(default, same)
    assert (default != other).mean() > 0.5


def test_there_is_no_wall(landscapes):
    for heights in landscapes[:10]:
        border = np.r_[heights[0], heights[-1], heights[:, 0], heights[:, -1]]
        assert border.mean() < 0.4
        assert border.max() - border.min() > 0.3


def ground(env, x, y=0.0):
    """Height of the ground at a place, m, by a ray from above."""
    direction, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, dtype=np.int32)
    distance = mujoco.mj_ray(
        env.model, env.data, np.array([x, y, 5.0]), direction, None, 1, env.model.body("torso").id, geom
    )
    assert geom[0] == env.model.geom("floor").id
    return 5.0 - distance


@pytest.mark.parametrize("env_id", HILLY_IDS)
def test_the_field_stands_where_the_numbers_say(env_id):
    for difficulty in (0.3, 2.0):
        env = make(env_id, difficulty=difficulty, terrain_seed=3)
        put(env, env._copies.init_qpos + (20 * (np.arange(env.model.nq) == 0) if "Cheetah" not in env_id else 0), 0)
        heights = terrain.hills(3)
        axis = np.linspace(-terrain.RADIUS, terrain.RADIUS, terrain.CELLS)
        for row, column in ((300, 320), (150, 400), (278, 50)):
            expected = terrain.GROUND + difficulty * heights[row, column]
            assert ground(env, axis[column] + 1e-6, axis[row] + 1e-6) == pytest.approx(expected, abs=1e-4)


def test_small_difficulties_are_nearly_flat():
    for difficulty in (0, 0.01, 0.05):
        model = make("rllab/HalfCheetahHilly-v0", difficulty=difficulty).model
        assert model.hfield_size[0, 2] == 0.05
        heights = 0.05 * model.hfield_data.reshape(terrain.CELLS, terrain.CELLS)
        assert heights.max() <= 0.05
        assert np.abs(np.diff(heights, axis=1)).max() < 0.01  # over cells of 0.144 m


@pytest.mark.parametrize("env_id", HILLY_IDS)
def test_no_robot_starts_in_the_ground(env_id, landscapes):
    env = make(env_id, difficulty=3.0)
    for seed, heights in enumerate(landscapes):
        env.model.hfield_data[:] = heights.ravel()
        env.reset(seed=seed)
        assert env.data.ncon == 0
        assert np.abs(env.data.geom_xpos[1:, 0]).max() < terrain.FLAT - 0.3  # a foot is shorter than 0.3 m


def test_the_start_is_flat(landscapes):
    axis = np.linspace(-terrain.RADIUS, terrain.RADIUS, terrain.CELLS)
    start = np.abs(axis) <= terrain.FLAT
    assert start.sum() > 10
    assert not landscapes[:, start][:, :, start].any()
    assert landscapes[:, np.abs(axis) < 5].any()


def test_a_robot_stands_on_the_hills():
    """Dropped far from the start it comes to rest on the field's surface and not on the plane below."""
    env = make("rllab/HalfCheetahHilly-v0", difficulty=1.0, terrain_seed=0)
    row = terrain.CELLS // 2
    heights = terrain.hills(0)[row]
    column = int(np.argmax(heights))
    x = np.linspace(-terrain.RADIUS, terrain.RADIUS, terrain.CELLS)[column]
    qpos = np.zeros(9)
    qpos[:2] = x, 1.5
    put(env, qpos, 0)
    for _ in range(150):
        env.step(np.zeros(6))
    assert env.data.ncon > 0
    assert env.data.geom_xpos[1:, 2].min() > terrain.GROUND + 0.1
