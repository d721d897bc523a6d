"""Pictures of simulations and plots of what runs write.

`picture` gives a picture as an array, and `View` the same for many moments, all alike; `save_png` and `save_gif` write them, and `save_mp4` with the extra `barchan[video]`.
What is drawn with matplotlib needs the extra `barchan[plot]`: `plot_height_map`, `plot_trace`, `plot_ledger`. `log_to_rerun` shows a simulation in the viewer of `rerun-sdk` (`barchan[rerun]`).
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from barchan._core import Simulation, View, write_gif, write_png
from barchan.errors import FileError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["View", "log_to_rerun", "picture", "plot_height_map", "plot_ledger", "plot_trace", "save_gif", "save_mp4", "save_png"]


def picture(simulation: Simulation, *, part: Literal["page", "ground"] = "page", world: int = 0) -> NDArray[np.uint8]:
    """A picture of a world as it is now: (rows, columns, 3), uint8, RGB. `part` is "page", or "ground" without title, scales and cut.

    Use a `View` for pictures that are to be compared: it keeps extent and colours.
    """
    return View(simulation, world=world).draw(simulation, part=part, world=world)


def _pixels(picture: Any) -> NDArray[np.uint8]:
    """A picture as it is written, if it is one."""
    given = np.asarray(picture)
    if given.dtype != np.uint8 or given.ndim != 3 or given.shape[2] != 3:
        raise ValueError(f"picture: it is an array of {given.dtype} of shape {given.shape}; give uint8 of shape (rows, columns, 3), RGB from 0 to 255")
    return np.ascontiguousarray(given)


def save_png(path: str | os.PathLike[str], picture: NDArray[np.uint8]) -> None:
    """Writes a picture as a PNG file: (rows, columns, 3), uint8, RGB."""
    write_png(path, _pixels(picture))


def save_gif(path: str | os.PathLike[str], pictures: Sequence[NDArray[np.uint8]], *, seconds: float = 0.04, most_bytes: int = 8_000_000) -> None:
    """Writes pictures of one size as an endless animation, each shown for `seconds`. Every second one is left out until the file has at most `most_bytes`."""
    write_gif(path, [_pixels(one) for one in pictures], seconds=seconds, most_bytes=most_bytes)


def save_mp4(path: str | os.PathLike[str], pictures: Iterable[NDArray[np.uint8]], *, seconds: float = 0.04) -> None:
    """Writes pictures of one size as a film (H.264), each shown for `seconds`; they may come one by one. An odd last row or column is left out.

    Raises `FileError` if it cannot be written, and `ValueError` for a name that does not end as films do: with .mp4, .m4v, .mov or .mkv.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError("imageio-ffmpeg is missing: pip install 'barchan[video]'") from error
    if not os.fspath(path).lower().endswith((".mp4", ".m4v", ".mov", ".mkv")):
        raise ValueError(f"{os.fspath(path)}: a film's name ends with .mp4, .m4v, .mov or .mkv")
    if not 1e-3 <= seconds <= 1e3:
        raise ValueError(f"seconds: {seconds}; give how long a picture is shown, from 0.001 to 1000 s")
    writer, first = None, None
    try:
        for picture in map(_pixels, pictures):
            if min(picture.shape[:2]) < 2:
                raise ValueError(f"pictures: one has the shape {picture.shape}; a film takes two rows and columns at least")
            rows, columns = (size - size % 2 for size in picture.shape[:2])
            if writer is None:
                first = picture.shape
                # ffmpeg is not asked how it ended: what it leaves tells.
                with open(path, "wb"):
                    pass
                writer = imageio_ffmpeg.write_frames(
                    os.fspath(path), (columns, rows), fps=1.0 / seconds, macro_block_size=2, ffmpeg_log_level="error"
                )
                writer.send(None)
            if picture.shape != first:
                raise ValueError(f"pictures: one has the shape {picture.shape} and the first {first}; draw them with one View")
            writer.send(np.ascontiguousarray(picture[:rows, :columns]))
    except OSError as error:
        what = str(error).split("\n")[0] if writer is None else "ffmpeg has ended early; is the disk full?"
        raise FileError(f"{os.fspath(path)}: writing a film: {what}") from error
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        raise ValueError("pictures: there are none")
    if os.path.getsize(path) == 0:
        raise FileError(f"{os.fspath(path)}: writing a film: ffmpeg has written nothing")


def plot_height_map(simulation: Simulation, *, cell: float | None = None, world: int = 0, axes: Axes | None = None) -> Axes:
    """Plots the height of the ground, seen from above [m]."""
    axes = _axes(axes)
    ground = simulation.height_map(cell=cell, world=world)
    half_x, half_y = (0.5 * (line[1] - line[0]) if len(line) > 1 else 0.5 for line in (ground.x, ground.y))
    extent = (ground.x[0] - half_x, ground.x[-1] + half_x, ground.y[0] - half_y, ground.y[-1] + half_y)
    shown = axes.imshow(ground.heights.T, origin="lower", extent=extent)
    axes.figure.colorbar(shown, ax=axes, label="height [m]")
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{simulation.name}, t = {simulation.times[world]:.3f} s")
    return axes


def plot_trace(path: str | os.PathLike[str], columns: str | Sequence[str] = "* mean f*", *, axes: Axes | None = None) -> Axes:
    """Plots columns of a run's `trace.csv` over time. `columns` are patterns with stars, such as "blade f*".

    Raises `ValueError` listing the columns that there are if none fits.
    """
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        names = next(reader)
        rows = [[float(cell) if cell else np.nan for cell in row] for row in reader]
    patterns = [columns] if isinstance(columns, str) else list(columns)
    wanted = [i for i, name in enumerate(names) if any(fnmatchcase(name, pattern) for pattern in patterns)]
    times = [i for i, name in enumerate(names) if name.split(" ")[0] == "time"]
    if not wanted or not times:
        raise ValueError(f"columns: none of {patterns} fits; {os.fspath(path)} has {', '.join(names)}")
    axes = _axes(axes)
    table = np.array(rows)
    for i in wanted:
        axes.plot(table[:, times[0]], table[:, i], label=names[i])
    axes.set(xlabel="time [s]")
    axes.legend()
    return axes


def plot_ledger(ledgers: Sequence[dict[str, Any]], times: Sequence[float], *, axes: Axes | None = None) -> Axes:
    """Plots energies of ledgers taken at several times: `ledgers` are what `Simulation.ledger` gave, `times` when [s]."""
    axes = _axes(axes)
    for name in ("kinetic", "elastic", "potential", "body_kinetic", "body_potential"):
        energies = [np.nan if ledger[name] is None else ledger[name] for ledger in ledgers]
        if np.any(np.nan_to_num(energies) != 0.0):
            axes.plot(times, energies, label=name.replace("_", " "))
    axes.set(xlabel="time [s]", ylabel="energy [J]")
    axes.legend()
    return axes


def log_to_rerun(
    simulation: Simulation,
    recording: Any = None,
    *,
    colour: Literal["speed", "level"] = "speed",
    fastest: float = 1.0,
    newtons: float = 1e-3,
    world: int = 0,
) -> None:
    """Logs a world as it is now to a recording of rerun, or to the one of `rerun.init`: call it after every few steps.

    Particles are coloured by their speed, up to `fastest` [m/s], or by their level; tools, bodies and robots come as meshes, the levels as boxes, and the
    force of the ground on each body as an arrow, `newtons` [m/N] long.
    """
    try:
        import rerun
    except ImportError as error:
        raise ImportError("rerun-sdk is missing: pip install 'barchan[rerun]'") from error

    def log(name: str, entity: Any) -> None:
        rerun.log(f"world/{name}", entity, recording=recording)

    rerun.set_time("time", duration=simulation.times[world], recording=recording)
    particles = simulation.particles("velocity", "volume0", "level", world=world)
    if colour == "level":
        share = particles.level / max(len(simulation.level_boxes(world=world)), 1)
    else:
        share = np.linalg.norm(particles.velocity, axis=1) / fastest
    slow, fast = np.array([194, 160, 110]), np.array([190, 40, 30])
    colours = (slow + np.clip(share, 0.0, 1.0)[:, None] * (fast - slow)).astype(np.uint8)
    radii = 0.5 * np.cbrt(particles.volume0)
    log("particles", rerun.Points3D(particles.position.astype(np.float32), colors=colours, radii=radii))
    for level, boxes in enumerate(simulation.level_boxes(world=world)):
        log(f"levels/{level}", rerun.Boxes3D(mins=boxes[:, 0], sizes=boxes[:, 1] - boxes[:, 0]))
    for number, surface in enumerate(simulation.surfaces(world=world)):
        corners = surface.triangles.reshape(-1, 3)
        shade = np.array(surface.colour or (0.45, 0.47, 0.5))
        w, *xyz = surface.rotation
        log(f"bodies/{number}", rerun.Transform3D(translation=surface.position, quaternion=rerun.Quaternion(xyzw=[*xyz, w])))
        mesh = rerun.Mesh3D(
            vertex_positions=corners,
            triangle_indices=np.arange(len(corners)).reshape(-1, 3),
            vertex_colors=np.tile((255 * shade).astype(np.uint8), (len(corners), 1)),
        )
        log(f"bodies/{number}", mesh)
    bodies, wrenches = simulation.bodies(world=world), simulation.wrenches(world=world)
    origins = [bodies[name].position for name in wrenches]
    log("forces", rerun.Arrows3D(origins=origins, vectors=[newtons * wrench.force for wrench in wrenches.values()]))


def _axes(axes: Axes | None) -> Axes:
    """Axes to draw into: new ones, if none are given."""
    if axes is not None:
        return axes
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError("matplotlib is missing: pip install 'barchan[plot]'") from error
    return pyplot.subplots()[1]
