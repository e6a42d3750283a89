"""The hilly ground of the paper's HalfCheetah Hilly, Walker2d Hilly and Hopper Hilly.

rllab (rllab/envs/mujoco/hill/terrain.py at ba78e4c) draws the hills as the maximum of Gaussian bumps, plots them with
matplotlib and lets MuJoCo read the picture. What its tasks look like therefore depends on the plot's colours and
margins: a bump's height goes through the red channel of its colour, and one unit of the plot becomes 1.8 m. Both are
kept here as numbers. Not kept are the steps of 1 cm between the plot's 100 layers, the page margin, which stood around
the field as a wall, and the offset by which the plot missed the origin, so that a hopper started inside a hill.
"""

import mujoco
import numpy as np

RADIUS = 40.0  # half the side of the square field, m
CELLS = 557  # grid points along each side, 0.144 m apart as along x in rllab's picture
UNIT = 1.8  # m per unit of rllab's plot
PITCH = 40 / np.sqrt(500) * UNIT  # distance of neighbouring hills before they are moved, m
JITTER = np.sqrt(0.4) * UNIT  # standard deviation of that move, m
GROUND = -0.1  # height of the valley floor, m

# The picture's levels of red, 0 to 255, where the bumps' density is 0, 0.05, ... 0.4: matplotlib's colour map "Greens",
# light for high ground. MuJoCo reads them as elevations, from none to the highest.
DENSITIES = np.linspace(0, 0.4, 9)
REDS = np.array([0, 0, 35, 65, 116, 161, 199, 229, 247])

FLAT = 1.2  # half the side of the square around the start that is really flat, m
RIM = 1.6  # width of the band around it over which the hills rise to their full height, m


def hills(seed: int) -> np.ndarray:
    """Elevations in [0, 1] of a landscape, [CELLS, CELLS]; rows run along y and columns along x, from -RADIUS up."""
    generator = np.random.default_rng(seed)
    axis = np.linspace(-RADIUS, RADIUS, CELLS)
    lattice = np.arange(-RADIUS, RADIUS, PITCH)
    centers = np.stack(np.meshgrid(lattice, lattice), axis=-1).reshape(-1, 2)
    centers += JITTER * generator.standard_normal(centers.shape)
    variances = 0.4 + 0.4 * generator.random(len(centers))  # in rllab's units

    # Below a density of 0.05 the ground is flat, and no bump is denser than that further away than this.
    reach = int(np.ceil(1.5 * UNIT / (axis[1] - axis[0])))
    density = np.zeros((CELLS, CELLS))
    for (x, y), variance in zip(centers, variances, strict=True):
        column, row = np.searchsorted(axis, [x, y])
        columns, rows = (slice(max(middle - reach, 0), middle + reach) for middle in (column, row))
        along_x, along_y = (
            np.exp(-(((axis[cells] - center) / UNIT) ** 2) / (2 * variance))
            for cells, center in ((columns, x), (rows, y))
        )
        bump = np.outer(along_y, along_x) / (2 * np.pi * variance)
        np.maximum(density[rows, columns], bump, out=density[rows, columns])

    # The start is cleared before the heights are looked up, as in rllab: its rim is the steepest place of the field.
    distance = np.maximum(*np.abs(np.meshgrid(axis, axis)))
    rise = np.clip((distance - FLAT) / RIM, 0, 1)
    density *= rise**2 * (3 - 2 * rise)
    return np.interp(density, DENSITIES, REDS) / 255


def add_terrain(spec: mujoco.MjSpec, difficulty: float) -> None:
    """Replace the floor by a field of heights up to `difficulty` metres; they are to be written after compiling.

    As in rllab, no difficulty is below 0.05.
    """
    height = max(difficulty, 0.05)
    placeholder = np.zeros(CELLS * CELLS)
    spec.add_hfield(name="hills", nrow=CELLS, ncol=CELLS, size=[RADIUS, RADIUS, height, 0.1], userdata=placeholder)
    floor = spec.geom("floor")
    floor.type = mujoco.mjtGeom.mjGEOM_HFIELD
    floor.hfieldname = "hills"
    floor.pos = [0, 0, GROUND]
