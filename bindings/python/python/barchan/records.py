"""What a simulation says: records of numbers and NumPy arrays.

All is in SI units and world axes, z up, unless a field says otherwise; quaternions are (w, x, y, z). Every array is a copy: it stays as it is when the simulation goes on,
and to write into it changes nothing there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Batch",
    "Body",
    "BodyArrays",
    "BodyGradient",
    "Chamfer",
    "HeightMap",
    "HeightScan",
    "Impulse",
    "Law",
    "Link",
    "Particles",
    "Patch",
    "Plan",
    "Robot",
    "RobotArrays",
    "RobotGradient",
    "Surface",
    "Task",
    "Wrench",
]


class Particles:
    """Arrays of particles, all in one order, which is the simulation's own and changes as it goes on; ``id`` stays.

    ``position`` is always there. What a law remembers is named after both, such as ``history_sand_volume_gap``. In an f64 run all numbers are float64. A field that was not read is an ``AttributeError`` that says so. ``len(particles)`` is their number n.
    """

    position: NDArray[np.float64]
    """Where they are in the world [m], (n, 3)."""
    velocity: NDArray[np.float32] | NDArray[np.float64]
    """Velocity [m/s], (n, 3)."""
    affine: NDArray[np.float32] | NDArray[np.float64]
    """APIC affine matrix C, row by row [1/s], (n, 9)."""
    mass: NDArray[np.float32] | NDArray[np.float64]
    """Mass [kg], (n,)."""
    volume0: NDArray[np.float32] | NDArray[np.float64]
    """Volume at rest [m^3], (n,)."""
    id: NDArray[np.uint64]
    """Number of the particle, the same throughout a run, (n,)."""
    body: NDArray[np.uint16]
    """Number of the scene's body that it was seeded for, (n,)."""
    material: NDArray[np.uint16]
    """Number of the material, in the scene's order, (n,)."""
    level: NDArray[np.uint8]
    """Level of the grid that it is on, 0 is the finest, (n,)."""
    density: NDArray[np.float32] | NDArray[np.float64]
    """Density as strain has it [kg/m^3], (n,)."""
    strain: NDArray[np.float32] | NDArray[np.float64]
    """Elastic left Cauchy-Green strain b: xx, yy, zz, xy, xz, yz, (n, 6)."""
    def_grad: NDArray[np.float32] | NDArray[np.float64]
    """Elastic deformation gradient F, row by row, (n, 9); NaN where a law keeps b alone."""
    stress: NDArray[np.float32] | NDArray[np.float64]
    """Cauchy stress [Pa]: xx, yy, zz, xy, xz, yz, (n, 6)."""
    pressure: NDArray[np.float64]
    """Minus a third of the trace of the Cauchy stress [Pa], (n,); of a cut only."""

    def __init__(self, **fields: NDArray[Any]) -> None:
        self.__dict__.update(fields)

    def __len__(self) -> int:
        return len(self.position)

    def __getattr__(self, name: str) -> Any:
        if name in type(self).__annotations__:
            hint = "it comes with Simulation.cut" if name == "pressure" else f"a Simulation reads it: particles({name!r})"
            raise AttributeError(f"'{name}' was not read; {hint}")
        raise AttributeError(f"particles have no '{name}'; these have {', '.join(self.__dict__)}")

    def __repr__(self) -> str:
        return f"<Particles: {len(self)}, with {', '.join(self.__dict__)}>"


class Batch:
    """Particles that a material written in Python updates (`barchan.add_material`). Arrays are float32, or float64 in f64 runs; column i is particle i."""

    dt: float
    """Step that the strain was carried over [s]; 0 asks for stress at the given strain."""
    parameters: dict[str, float]
    """The material's parameters, as the scene gives them."""
    strain_trial: NDArray[Any]
    """Strain before the law has acted, (6 or 9, n): b rows xx yy zz xy xz yz, or F row by row."""
    state_in: NDArray[Any]
    """History before that, (variables, n)."""
    strain: NDArray[Any]
    """Strain that remains, (6 or 9, n): what was given, unless the law sets it."""
    kirchhoff: NDArray[Any]
    """Kirchhoff stress [Pa], (6, n), rows xx yy zz xy xz yz: 0, unless the law sets it."""
    state_out: NDArray[Any]
    """History that remains, (variables, n): what was given, unless the law sets it."""

    def __init__(self, dt: float, parameters: dict[str, float], strain_trial: NDArray[Any], state_in: NDArray[Any]) -> None:
        self.dt, self.parameters, self.strain_trial, self.state_in = dt, parameters, strain_trial, state_in
        self.strain, self.state_out = strain_trial.copy(), state_in.copy()
        self.kirchhoff = np.zeros((6, strain_trial.shape[1]), strain_trial.dtype)

    def __len__(self) -> int:
        return self.strain_trial.shape[1]


class Law(Protocol):
    """A material written in Python, for `barchan.add_material`. It may have `states`, `strain` and `tangent_moduli` besides."""

    name: str
    """In snake_case, as scenes call it."""
    parameters: dict[str, Any]
    """Name, and default or (default, unit)."""

    def update(self, batch: Batch) -> None:
        """Sets what comes of a batch of particles."""


@dataclass(frozen=True, eq=False)
class Body:
    """What a tool, a free body or a link of a robot is doing."""

    name: str
    position: NDArray[np.float64]
    """Centre of mass [m], (3,)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion (w, x, y, z), (4,)."""
    velocity: NDArray[np.float64]
    """Velocity of the centre of mass [m/s], (3,)."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity [rad/s], (3,)."""
    mass: float
    """Mass [kg]; infinite for a driven body."""


@dataclass(frozen=True, eq=False)
class Wrench:
    """Force on a body, and torque about its centre of mass."""

    force: NDArray[np.float64]
    """Force [N], (3,)."""
    torque: NDArray[np.float64]
    """Torque [N m], (3,)."""


@dataclass(frozen=True, eq=False)
class Impulse:
    """What the soft ground gave to a tool over a tape."""

    impulse: NDArray[np.float64]
    """Impulse [N s], (3,)."""
    angular_impulse: NDArray[np.float64]
    """Angular impulse about the tool's position, which is its centre of mass if it is free and its frame's origin if it is driven [N m s], (3,)."""


@dataclass(frozen=True, eq=False)
class BodyGradient:
    """Derivatives of a loss by a tool, or by the base or a link of a robot. Where the whole robot is, and how it moves, is by its base: of links these are 0. Positions are those of `Simulation.bodies`: a base's is its centre of mass, while `Simulation.place` takes the origin of its frame."""

    position: NDArray[np.float64]
    """By its position at the start of the tape [1/m], (3,); 0 if it moves along keyframes."""
    rotation: NDArray[np.float64]
    """By its rotation there, as a small turn on top of it, about axes through its position along the world's [1/rad], (3,); 0 if it moves along keyframes."""
    velocity: NDArray[np.float64]
    """By its velocity at the start, if it is free or a force pushes it [s/m], (3,); of a driven one see `linear`."""
    angular_velocity: NDArray[np.float64]
    """By its angular velocity at the start, if it is free [s/rad], (3,)."""
    linear: NDArray[np.float64]
    """By its velocity over the tape, if it is driven by velocity [s/m], (3,)."""
    angular: NDArray[np.float64]
    """By its angular velocity over the tape, likewise [s/rad], (3,)."""
    keyframes: NDArray[np.float64]
    """By the positions of its n keyframes, if it moves along some [1/m], (n, 3)."""
    friction: float
    """By its coefficient of friction; 0 for contact that knows none. Of a robot it is of all links together."""
    mass: float
    """By its mass, with which its inertia grows, if it is free, a link, or a force pushes it [1/kg]. Where the scene gives a servo none, `force` counts it in."""
    force: float
    """By the whole force of its servo [1/N], with the mass that follows it where the scene gives none; by a pressure it is the area times that."""


@dataclass(frozen=True, eq=False)
class RobotGradient:
    """Derivatives of a loss by a robot's joints, n of them, in the order of commands to it. Its base and links are among `Gradient.bodies`."""

    positions: NDArray[np.float64]
    """By their positions at the start of the tape [1/rad or 1/m], (n,)."""
    rates: NDArray[np.float64]
    """By their rates there [s/rad or s/m], (n,)."""
    targets: NDArray[np.float64]
    """By the targets that their motors were told over the tape [1/rad or 1/m], (n,): 0 at a joint's limit, within which they are kept; of motion that the scene gives, by all of its positions alike."""
    target_rates: NDArray[np.float64]
    """By the target rates, likewise [s/rad or s/m], (n,)."""
    torques: NDArray[np.float64]
    """By the torques or forces that they were told [1/(N m) or 1/N], (n,)."""
    kp: NDArray[np.float64]
    """By their gains: torque for each unit of position, (n,)."""
    kd: NDArray[np.float64]
    """Torque for each unit of rate, (n,)."""


@dataclass(frozen=True, eq=False)
class Link:
    """How a link of a robot moves, and what it feels."""

    name: str
    position: NDArray[np.float64]
    """Centre of mass [m], (3,)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion (w, x, y, z), (4,)."""
    velocity: NDArray[np.float64]
    """Velocity of the centre of mass [m/s], (3,)."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity [rad/s], (3,)."""
    ground: Wrench
    """What the soft ground does to it, the mean over the last step."""
    felt: Wrench
    """What soft ground and rigid things do to it together."""
    contact_points: NDArray[np.float64]
    """Where it touched what is rigid in the last step [m], (k, 3)."""
    contact_forces: NDArray[np.float64]
    """Mean force on the link at each of these points [N], (k, 3)."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Where a link is touched."""

    points: int
    """How many particles and points of rigid contact touch it."""
    low: NDArray[np.float64]
    """Least corner of the box that holds them [m], (3,)."""
    high: NDArray[np.float64]
    """Greatest corner of that box [m], (3,)."""
    centre_of_pressure: NDArray[np.float64]
    """Where the whole force goes through: where its line comes nearest to their middle [m], (3,)."""


@dataclass(frozen=True, eq=False)
class Robot:
    """How a robot's base and joints move, and what its links feel. Joints come in the order of commands to them."""

    name: str
    position: NDArray[np.float64]
    """Origin of the base's frame [m], (3,)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion of the base (w, x, y, z), (4,)."""
    velocity: NDArray[np.float64]
    """Velocity of that origin, along the base's axes [m/s], (3,)."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity, along the base's axes [rad/s], (3,): what a gyroscope reads."""
    specific_force: NDArray[np.float64]
    """Acceleration less gravity, along the base's axes [m/s^2], (3,): what an accelerometer reads."""
    projected_gravity: NDArray[np.float64]
    """Where gravity points, a unit vector along the base's axes, (3,); zero without gravity."""
    joint_names: list[str]
    joint_position: NDArray[np.float64]
    """Angle [rad] or displacement [m] of each joint, (joints,)."""
    joint_rate: NDArray[np.float64]
    """Its rate [rad/s or m/s], (joints,)."""
    joint_torque: NDArray[np.float64]
    """Torque [N m] or force [N] that its motor gives as it is now, by what it was told last, (joints,): after a step, that of the step."""
    links: dict[str, Link] = field(repr=False)
    """Links with mass or shape by name, the base first."""


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """What a tool, a free body or a link of a robot does in each of w worlds."""

    position: NDArray[np.float64]
    """Centre of mass [m], (w, 3)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion (w, x, y, z), (w, 4)."""
    velocity: NDArray[np.float64]
    """Velocity of the centre of mass [m/s], (w, 3)."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity [rad/s], (w, 3)."""
    mass: NDArray[np.float64]
    """Mass [kg], (w,); infinite for a driven body."""
    force: NDArray[np.float64]
    """Mean force of the soft ground over the last step [N], (w, 3)."""
    torque: NDArray[np.float64]
    """Its torque about the centre of mass [N m], (w, 3)."""


@dataclass(frozen=True, eq=False)
class RobotArrays:
    """How a robot moves in each of w worlds, and what its links feel. Joints come in the order of commands to them."""

    joint_names: list[str]
    link_names: list[str]
    """Links with mass or shape, the base first."""
    position: NDArray[np.float64]
    """Origin of the base's frame [m], (w, 3)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion of the base (w, x, y, z), (w, 4)."""
    velocity: NDArray[np.float64]
    """Velocity of that origin, along the base's axes [m/s], (w, 3)."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity, along the base's axes [rad/s], (w, 3): what a gyroscope reads."""
    specific_force: NDArray[np.float64]
    """Acceleration less gravity, along the base's axes [m/s^2], (w, 3): what an accelerometer reads."""
    projected_gravity: NDArray[np.float64]
    """Where gravity points, a unit vector along the base's axes, (w, 3); zero without gravity."""
    joint_position: NDArray[np.float64]
    """Angle [rad] or displacement [m] of each joint, (w, joints)."""
    joint_rate: NDArray[np.float64]
    """Its rate [rad/s or m/s], (w, joints)."""
    joint_torque: NDArray[np.float64]
    """Torque [N m] or force [N] that its motor gives as it is now, by what it was told last, (w, joints): after a step, that of the step."""
    link_position: NDArray[np.float64]
    """Centre of mass of each link [m], (w, links, 3)."""
    link_rotation: NDArray[np.float64]
    """Its orientation quaternion (w, x, y, z), (w, links, 4)."""
    link_velocity: NDArray[np.float64]
    """Velocity of its centre of mass [m/s], (w, links, 3)."""
    link_angular_velocity: NDArray[np.float64]
    """Its angular velocity [rad/s], (w, links, 3)."""
    ground_force: NDArray[np.float64]
    """Mean force of the soft ground on it over the last step [N], (w, links, 3)."""
    ground_torque: NDArray[np.float64]
    """Its torque about the centre of mass [N m], (w, links, 3)."""
    felt_force: NDArray[np.float64]
    """Force of soft ground and rigid things together [N], (w, links, 3)."""
    felt_torque: NDArray[np.float64]
    """Their torque about the centre of mass [N m], (w, links, 3)."""
    heights: NDArray[np.float64] | None
    """How high the ground at the points of the robot's scan is above the origin of the base's frame [m], (w, n), negative below; NaN where there is neither ground nor floor. None if it
    was not asked for."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A part of what a tool, a free body or a robot looks like."""

    triangles: NDArray[np.float32] = field(repr=False)
    """Corners of the triangles in a frame of the body's [m], (n, 3, 3)."""
    position: NDArray[np.float64]
    """Where the origin of that frame is [m], (3,)."""
    rotation: NDArray[np.float64]
    """Orientation quaternion of that frame (w, x, y, z), (4,)."""
    colour: tuple[float, float, float] | None
    """sRGB from 0 to 1; None for a tool's."""


@dataclass(frozen=True, eq=False)
class Chamfer:
    """How far particles and a cloud of points are from one another."""

    to_points: float
    """Mean distance of the particles to the nearest of the points [m]; NaN without particles or points."""
    from_points: float
    """Mean distance of the points to the nearest particle [m]; NaN without particles or points."""
    distances: NDArray[np.float64]
    """Distance of each point to the nearest particle [m], (n,); NaN without particles."""
    ids: NDArray[np.uint64]
    """Number of that particle, (n,); the greatest of this type without particles."""

    @property
    def distance(self) -> float:
        """Chamfer distance: both means together [m]."""
        return self.to_points + self.from_points


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Heights of the ground over a rectangle."""

    heights: NDArray[np.float64]
    """Height at (x[i], y[j]) [m], (nx, ny); NaN where there is neither ground nor floor."""
    x: NDArray[np.float64]
    """Where the rows are [m], (nx,)."""
    y: NDArray[np.float64]
    """Where the columns are [m], (ny,)."""


@dataclass(frozen=True, eq=False)
class HeightScan:
    """Heights of the ground at points around a robot."""

    points: NDArray[np.float64]
    """Where the points are in the world [m], (n, 2), rows along x."""
    heights: NDArray[np.float64]
    """How high the surface there is above the origin of the base's frame [m], (n,), negative below; NaN where there is neither ground nor floor."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What a scene calls for and why. ``print(plan)`` shows all of it."""

    text: str = field(repr=False)
    """The plan as people read it, as ``barchan plan`` prints it."""
    effects: dict[str, str]
    """Every effect that is simulated, and which keys of the scene call for it."""
    stages: str
    """The stages of a step, in order."""
    particle_count: int
    cell_widths: list[float]
    """Cell width of each level, finest first [m]."""
    time_step: float
    """The step that the run starts with [s]."""
    warnings: list[str]
    """What you should know about the scene."""

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class Task:
    """What a benchmark task asks for, and what an action and an observation hold."""

    name: str
    doc: str = field(repr=False)
    action_names: list[str]
    """What the numbers of an action are, with their units."""
    action_low: NDArray[np.float64]
    """Least value of each, (numbers,)."""
    action_high: NDArray[np.float64]
    """Greatest value of each, (numbers,)."""
    observation_parts: list[tuple[str, int]]
    """Parts of an observation, one after the other: what the numbers are, and how many."""
    interval: float
    """Simulated time of a control step [s]."""
    horizon: int
    """Control steps after which an episode is cut off."""
    ranges: list[tuple[str, tuple[float, float]]]
    """What a seed changes, and between what it lies; empty if nothing."""

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return sum(size for _, size in self.observation_parts)
