"""The nine tasks of the GPO paper, and MuJoCo stepped in batches.

Importing this package registers `rllab/<Task>-v0` and gives Gymnasium's own MuJoCo ids a `vector_entry_point`, so that
`gym.make_vec(id, num_envs=n)` returns the batched form of this package instead of a `SyncVectorEnv`. Pass
`vectorization_mode="sync"` for the latter. `gym.make` is not touched.
"""

import gymnasium as gym

from gpo_envs import gymnasium_tasks, rllab

HORIZON = 512  # steps of an episode in the paper, "Other Hyperparameters"


def entry_point(creator: type) -> str:
    """The string by which Gymnasium's registry finds a class."""
    return f"{creator.__module__}:{creator.__name__}"


for task in gymnasium_tasks.TASKS:
    gym.spec(task.env_id).vector_entry_point = entry_point(task)

for env in rllab.TASKS:
    gym.register(
        env.task.env_id,
        entry_point=entry_point(env),
        vector_entry_point=entry_point(env.task),
        max_episode_steps=HORIZON,
    )
