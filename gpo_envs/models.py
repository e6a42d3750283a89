"""Compiled MuJoCo models: Gymnasium's installed assets, and the edits that turn them into rllab's."""

import mujoco
from gymnasium.envs.mujoco.mujoco_env import expand_model_path


def load_spec(xml_file: str) -> mujoco.MjSpec:
    """The editable form of one of Gymnasium's assets, or of a path that starts with ~, . or /.

    Raises:
        OSError: if there is no such file.
    """
    return mujoco.MjSpec.from_file(expand_model_path(xml_file))


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile `spec`, which is left as it was.

    half_cheetah.xml sets the compiler's `settotalmass`, which MuJoCo 4 honours but prints a deprecation warning for.
    Its advice, scaling the compiled model, gives the same arrays to the bit.
    """
    spec = spec.copy()
    total_mass = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    model = spec.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
