"""The nine tasks of the GPO paper, and MuJoCo stepped in batches.

Importing this package registers `rllab/<Task>-v0` and gives Gymnasium's own MuJoCo ids a `vector_entry_point`, so that
`gym.make_vec(id, num_envs=n)` returns the batched form of this package instead of a `SyncVectorEnv`. Pass
`vectorization_mode="sync"` for the latter. `gym.make` is not touched.
"""

import gymnasium as gym

from gpo_envs import gymnasium_tasks

HORIZON = 512  # steps per episode in the paper, section 4

GYMNASIUM_TASKS = (gymnasium_tasks.HalfCheetahV4, gymnasium_tasks.HalfCheetahV5)

for task in GYMNASIUM_TASKS:
    gym.spec(task.env_id).vector_entry_point = f"{task.__module__}:{task.__name__}"
