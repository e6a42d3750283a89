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


def use_old_capsule_masses(model: mujoco.MjModel, spec: mujoco.MjSpec) -> None:
    """Give the bodies of `model`, compiled from `spec`, the masses and inertias of MuJoCo before 2.1.1.

    Until then (changelog of 2.1.1) a capsule of radius r and half length h weighed as a solid cylinder of half length
    h + r / 2. rllab ran on MuJoCo 1.31, so this is what the paper's robots weighed: 2 % (HalfCheetah's torso) to 10 %
    (the double pendulum's cart) away from the exact value.
    """
    twin = spec.copy()
    for geom in twin.geoms:
        if model.geom_type[geom.id] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            radius, half_length, _ = model.geom_size[geom.id]
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            geom.fromto[0] = float("nan")  # the mark of "not given by its end points"
            geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            geom.pos, geom.quat = model.geom_pos[geom.id], model.geom_quat[geom.id]
            geom.size = [radius, half_length + radius / 2, 0]
    cylinders = compile_spec(twin)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        getattr(model, name)[:] = getattr(cylinders, name)
    mujoco.mj_setConst(model, mujoco.MjData(model))
