"""Batched stepping: Gymnasium's tasks to the bit, and Gymnasium's interface."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import gpo_envs  # noqa: F401
from gpo_envs import gymnasium_tasks, rllab

# Gymnasium says of every v4 id that it is out of date.
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date.*:DeprecationWarning")

GYMNASIUM_IDS = [task.env_id for task in gymnasium_tasks.TASKS]
RLLAB_IDS = [env.task.env_id for env in rllab.TASKS]

KEYWORDS = [
    ("HalfCheetah-v4", {"exclude_current_positions_from_observation": False, "ctrl_cost_weight": 0.3}),
    ("HalfCheetah-v5", {"frame_skip": 2, "forward_reward_weight": 0.7, "reset_noise_scale": 0.02}),
    ("Walker2d-v4", {"healthy_z_range": (1.0, 1.5), "exclude_current_positions_from_observation": False}),
    ("Walker2d-v5", {"xml_file": "walker2d.xml", "healthy_reward": 0.3}),
    ("Hopper-v4", {"terminate_when_unhealthy": False, "healthy_state_range": (-5, 5)}),
    ("Hopper-v5", {"terminate_when_unhealthy": False, "healthy_angle_range": (-0.1, 0.1)}),
    ("Ant-v4", {"use_contact_forces": True, "exclude_current_positions_from_observation": False}),
    ("Ant-v5", {"include_cfrc_ext_in_observation": False, "main_body": 2, "contact_force_range": (-0.5, 0.5)}),
    ("Swimmer-v4", {"exclude_current_positions_from_observation": False}),
    ("Swimmer-v5", {"ctrl_cost_weight": 0.01, "frame_skip": 3}),
    ("Humanoid-v4", {"exclude_current_positions_from_observation": False, "healthy_z_range": (1.2, 2.0)}),
    ("Humanoid-v5", {"include_cinert_in_observation": False, "include_qfrc_actuator_in_observation": False}),
    ("Humanoid-v5", {"include_cvel_in_observation": False, "contact_cost_weight": 1e-3, "contact_cost_range": (1, 2)}),
    ("InvertedPendulum-v5", {"reset_noise_scale": 0.1}),
    ("InvertedDoublePendulum-v5", {"healthy_reward": 3.0, "reset_noise_scale": 0.2}),
    ("Reacher-v5", {"reward_dist_weight": 0.5, "reward_control_weight": 0.3}),
    ("Pusher-v5", {"reward_near_weight": 0.2, "reward_dist_weight": 3, "reward_control_weight": 0.7}),
]


def assert_equal_to_gymnasium(env_id, steps, num_envs=2, dtype=np.float32, seed=7, **keywords):
    """Step both forms under the same actions; returns how many episodes ended."""
    ours = gym.make_vec(env_id, num_envs=num_envs, **keywords)
    theirs = gym.make_vec(
        env_id,
        num_envs=num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        disable_env_checker=True,
        **keywords,
    )
    assert type(ours).__module__.startswith("gpo_envs")
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.single_action_space == theirs.single_action_space
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
    generator = np.random.default_rng(seed)
    low, high = ours.action_space.low, ours.action_space.high
    ends = 0
    for _ in range(steps):
        actions = generator.uniform(low, high).astype(dtype)
        mine, original = ours.step(actions), theirs.step(actions)
        for ours_part, their_part in zip(mine[:4], original[:4], strict=True):
            assert ours_part.dtype == their_part.dtype
            np.testing.assert_array_equal(ours_part, their_part, strict=True)
        assert ("final_obs" in mine[4]) == ("final_obs" in original[4])
        if "final_obs" in original[4]:
            np.testing.assert_array_equal(mine[4]["_final_obs"], original[4]["_final_obs"])
            for last, their_last in zip(mine[4]["final_obs"], original[4]["final_obs"], strict=True):
                np.testing.assert_array_equal(last, their_last)
            ends += original[4]["_final_obs"].sum()
    ours.close()
    theirs.close()
    return ends


@pytest.mark.parametrize("env_id", GYMNASIUM_IDS)
def test_equals_gymnasium(env_id):
    assert assert_equal_to_gymnasium(env_id, steps=2000, num_envs=1, max_episode_steps=100) >= 20


@pytest.mark.parametrize(("env_id", "keywords"), KEYWORDS)
def test_keywords_equal_gymnasium(env_id, keywords):
    assert assert_equal_to_gymnasium(env_id, steps=60, num_envs=2, max_episode_steps=25, **keywords) >= 4


@pytest.mark.slow
@pytest.mark.parametrize("env_id", GYMNASIUM_IDS)
def test_equals_gymnasium_for_long(env_id):
    assert_equal_to_gymnasium(env_id, steps=5000, num_envs=5, seed=123)


def another(value):
    """A value that differs from a keyword's default."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return tuple(0.9 * bound for bound in value)
    return value + 1 if isinstance(value, int) else 1.5 * value


@pytest.mark.slow
@pytest.mark.parametrize("task", gymnasium_tasks.TASKS, ids=GYMNASIUM_IDS)
def test_every_keyword_equals_gymnasium(task):
    for name, default in task.keywords().items():
        if name != "xml_file":
            keyword = {name: another(default)}
            assert assert_equal_to_gymnasium(task.env_id, steps=80, max_episode_steps=20, **keyword) >= 8, keyword


@pytest.mark.parametrize("env_id", ["Ant-v5", "InvertedDoublePendulum-v4"])
def test_equals_gymnasium_with_actions_in_double_precision(env_id):
    assert assert_equal_to_gymnasium(env_id, steps=300, dtype=np.float64, max_episode_steps=50) >= 12


def test_serves_all_tasks_but_the_impossible():
    names = ("HalfCheetah", "Walker2d", "Hopper", "Ant", "Swimmer", "Humanoid", "Reacher", "Pusher")
    names += ("InvertedPendulum", "InvertedDoublePendulum")
    served = {f"{name}-v{version}" for name in names for version in (4, 5)} - {"Pusher-v4"}
    assert set(GYMNASIUM_IDS) == served
    for env_id in GYMNASIUM_IDS + RLLAB_IDS:
        assert gym.spec(env_id).vector_entry_point.startswith("gpo_envs")
    for env_id in ("HumanoidStandup-v5", "CartPole-v1", "Pusher-v4"):
        assert not str(gym.spec(env_id).vector_entry_point).startswith("gpo_envs")


def test_gym_make_is_untouched():
    env = gym.make("Hopper-v5").unwrapped
    assert type(env).__module__ == "gymnasium.envs.mujoco.hopper_v5"


@pytest.mark.parametrize("env_id", ["Hopper-v5", "rllab/Hopper-v0"])
def test_a_copy_does_not_depend_on_how_many_there_are(env_id):
    many, one = gym.make_vec(env_id, num_envs=5), gym.make_vec(env_id, num_envs=1)
    first, alone = many.reset(seed=[4, 8, 15, 16, 23])[0], one.reset(seed=16)[0]
    np.testing.assert_array_equal(first[3], alone[0])
    generator = np.random.default_rng(0)
    for _ in range(200):
        actions = generator.uniform(-1, 1, many.action_space.shape).astype(np.float32)
        part, whole = many.step(actions), one.step(actions[3:4])
        for mine, theirs in zip(part[:4], whole[:4], strict=True):
            np.testing.assert_array_equal(mine[3], theirs[0])


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "rllab/Walker2d-v0"])
def test_seeds_and_masks_work_as_in_gymnasium(env_id):
    ours = gym.make_vec(env_id, num_envs=3)
    theirs = gym.make_vec(env_id, num_envs=3, vectorization_mode="sync")
    mask = np.array([True, False, True])
    actions = np.zeros(ours.action_space.shape, dtype=np.float32)
    for seed, options in (
        (5, None),
        (None, None),
        ([3, None, 9], None),
        (np.int64(11), None),
        (None, {"reset_mask": mask}),
        ([1, 2, 3], {"reset_mask": mask}),
    ):
        for _ in range(2):  # the second time, generators stand where the first left them
            their_seed = int(seed) if isinstance(seed, np.integer) else seed
            ours_observations, _ = ours.reset(seed=seed, options=options)
            their_observations, _ = theirs.reset(seed=their_seed, options=dict(options) if options else None)
            np.testing.assert_array_equal(ours_observations, their_observations)
            np.testing.assert_array_equal(ours.step(actions)[0], theirs.step(actions)[0])
    assert options == {"reset_mask": mask}  # not taken out of the caller's dictionary


def test_a_mask_restarts_the_clock_of_its_copies_only():
    env = gym.make_vec("HalfCheetah-v5", num_envs=2, max_episode_steps=4)
    env.reset(seed=0)
    actions = np.zeros((2, 6), dtype=np.float32)
    for _ in range(3):
        assert not env.step(actions)[3].any()
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.step(actions)[3].tolist() == [False, True]
    for _ in range(2):
        assert not env.step(actions)[3].any()
    assert env.step(actions)[3].tolist() == [True, False]


@pytest.mark.parametrize(
    ("given", "expected"), [({}, 512), ({"max_episode_steps": 30}, 30), ({"max_episode_steps": None}, 512)]
)
def test_limit_is_the_ids_own_or_the_given_one(given, expected):
    env = gym.make_vec("rllab/HalfCheetah-v0", num_envs=2, **given)
    env.reset(seed=0)
    truncations = [env.step(np.zeros((2, 6), dtype=np.float32))[3].all() for _ in range(expected)]
    assert truncations == [False] * (expected - 1) + [True]


def test_no_limit():
    env = gym.make_vec("Reacher-v5", num_envs=1, max_episode_steps=-1)
    env.reset(seed=0)
    assert not any(env.step(np.zeros((1, 2), dtype=np.float32))[3].any() for _ in range(200))


def test_observations_are_copies_unless_asked_otherwise():
    for copy in (True, False):
        env = gym.make_vec("Hopper-v5", num_envs=2, copy=copy)
        first, _ = env.reset(seed=0)
        before = first.copy()
        second, *rest, _ = env.step(np.ones((2, 3), dtype=np.float32))
        assert np.array_equal(first, before) == copy
        assert np.shares_memory(first, second) != copy
        kept = [part.copy() for part in rest]
        env.step(np.zeros((2, 3), dtype=np.float32))
        for part, earlier in zip(rest, kept, strict=True):
            np.testing.assert_array_equal(part, earlier)


def test_final_observations_survive_later_steps():
    env = gym.make_vec("Hopper-v5", num_envs=2, copy=False, max_episode_steps=1)
    env.reset(seed=0)
    *_, infos = env.step(np.ones((2, 3), dtype=np.float32))
    kept = [last.copy() for last in infos["final_obs"]]
    env.step(np.zeros((2, 3), dtype=np.float32))
    for last, earlier in zip(infos["final_obs"], kept, strict=True):
        np.testing.assert_array_equal(last, earlier)


def test_gymnasiums_statistics_wrapper_counts_episodes():
    env = gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec("rllab/Swimmer-v0", num_envs=2, max_episode_steps=3))
    env.reset(seed=0)
    actions = np.ones((2, 2), dtype=np.float32)
    (*_, rewards1, _, _, _), (*_, rewards2, _, _, _), (_, rewards3, _, _, infos) = (env.step(actions) for _ in range(3))
    assert infos["episode"]["l"].tolist() == [3, 3]
    np.testing.assert_allclose(infos["episode"]["r"], rewards1 + rewards2 + rewards3)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "rllab/HalfCheetah-v0", "rllab/Hopper-v0"])
def test_divergence_is_reported(env_id, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of its warnings
    env = gym.make_vec(env_id, num_envs=3)
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    assert "diverged" not in env.step(actions)[4]
    env.datas[1].qvel[:] = 1e12
    _, _, terminations, _, infos = env.step(actions)
    assert infos["diverged"].tolist() == infos["_diverged"].tolist() == [False, True, False]
    assert terminations[1] == env_id.startswith("rllab")
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert "diverged" not in env.step(actions)[4]


def test_divergence_keeps_gymnasiums_bits(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ours, theirs = gym.make_vec("HalfCheetah-v5", num_envs=1), gym.make("HalfCheetah-v5")
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for data in (ours.datas[0], theirs.unwrapped.data):
        data.qvel[:] = 1e12
    for _ in range(5):
        mine, original = ours.step(np.ones((1, 6), dtype=np.float32)), theirs.step(np.ones(6, dtype=np.float32))
        np.testing.assert_array_equal(mine[0][0], original[0])
        assert mine[1][0] == original[1]
        assert mine[4]["diverged"][0]


@pytest.mark.parametrize("env_id", ["Ant-v5", "rllab/HopperHilly-v0", "InvertedPendulum-v4"])
def test_unknown_keywords_are_refused_by_name(env_id):
    with pytest.raises(TypeError, match="'dificulty'"):
        gym.make_vec(env_id, num_envs=1, dificulty=2)
    for name in ("render_mode", "default_camera_config", "width"):
        with pytest.raises(TypeError, match=name):
            gym.make_vec(env_id, num_envs=1, **{name: None})


def test_v4_refuses_keywords_of_v5():
    with pytest.raises(TypeError, match="frame_skip"):
        gym.make_vec("HalfCheetah-v4", num_envs=1, frame_skip=2)
    with pytest.raises(TypeError, match="'difficulty'"):
        gym.make_vec("rllab/Hopper-v0", num_envs=1, difficulty=2)


def test_mistakes_are_named():
    env = gym.make_vec("Hopper-v5", num_envs=2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="one seed for each of the 2"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(TypeError, match="boolean"):
        env.reset(options={"reset_mask": [True, False]})
    with pytest.raises(ValueError, match="shape"):
        env.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(ValueError, match="True entry"):
        env.reset(options={"reset_mask": np.array([False, False])})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(2, 3\), got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="num_envs"):
        gym.make_vec("Hopper-v5", num_envs=0)
    for limit in (0, -2):
        with pytest.raises(ValueError, match="max_episode_steps"):
            gym.make_vec("Hopper-v5", num_envs=1, max_episode_steps=limit)
