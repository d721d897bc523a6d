"""The package: its types are true, plugins load, pictures are pictures, and what the READMEs show works."""

import ast
import doctest
import inspect
import os
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import barchan
import barchan._core as core
from barchan import view

PACKAGE = Path(barchan.__file__).parent
ROOT = Path(__file__).parents[3]


def described(node):
    """Names and defaults of a function's arguments in the stubs."""
    arguments = node.args
    positional = arguments.posonlyargs + arguments.args
    defaults = [None] * (len(positional) - len(arguments.defaults)) + [ast.unparse(one) for one in arguments.defaults]
    found = [(one.arg, "positional", default) for one, default in zip(positional, defaults)]
    if arguments.vararg:
        found.append((arguments.vararg.arg, "rest", None))
    keyword = zip(arguments.kwonlyargs, arguments.kw_defaults)
    found += [(one.arg, "keyword", default and ast.unparse(default)) for one, default in keyword]
    return [(name, kind, default and default.replace("_", "").replace('"', "'")) for name, kind, default in found if name not in ("self", "cls")]


def actual(function):
    """The same of the module's."""
    kinds = {
        inspect.Parameter.POSITIONAL_OR_KEYWORD: "positional",
        inspect.Parameter.POSITIONAL_ONLY: "positional",
        inspect.Parameter.VAR_POSITIONAL: "rest",
        inspect.Parameter.KEYWORD_ONLY: "keyword",
    }
    parameters = inspect.signature(function).parameters.values()
    default = lambda one: None if one.default is inspect.Parameter.empty else repr(one.default).replace("_", "")
    return [(one.name, kinds[one.kind], default(one)) for one in parameters if one.name != "self"]


def test_the_stubs_are_what_the_module_has():
    assert (PACKAGE / "py.typed").exists()
    tree = ast.parse((PACKAGE / "_core.pyi").read_text())
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    public = {name for name in dir(core) if not name.startswith("_")}
    assert public == set(functions) | set(classes)
    for name, node in functions.items():
        assert actual(getattr(core, name)) == described(node), name
        assert getattr(core, name).__doc__, name
    for name, node in classes.items():
        cls = getattr(core, name)
        assert cls.__doc__, name
        methods = {one.name: one for one in node.body if isinstance(one, ast.FunctionDef)}
        assert {one for one in vars(cls) if not one.startswith("_")} == {one for one in methods if one != "__new__"}
        for method, described_as in methods.items():
            member = inspect.getattr_static(cls, method)
            if any(ast.unparse(one) == "property" for one in described_as.decorator_list):
                assert inspect.isgetsetdescriptor(member) and member.__doc__, f"{name}.{method}"
                continue
            function = cls if method == "__new__" else getattr(cls, method)
            assert actual(function) == described(described_as), f"{name}.{method}"
            assert function.__doc__, f"{name}.{method}"


def test_every_exception_is_in_one_tree_and_at_hand():
    from barchan import errors

    for name in errors.__all__:
        assert issubclass(getattr(errors, name), barchan.BarchanError)
        assert getattr(barchan, name) is getattr(errors, name) and name in barchan.__all__


def test_the_registry_names_laws_and_their_parameters():
    known = barchan.registry()
    assert set(known) == {"materials", "couplings", "backends", "tasks"}
    young = known["materials"]["sand"]["parameters"]["young_modulus"]
    assert young["unit"] == "Pa" and young["kind"] == "number"
    assert {"cpu", "wgpu"} <= set(known["backends"])


def test_a_material_of_a_library_is_as_good_as_a_built_in_one(press, tmp_path):
    compiler = shutil.which("cc")
    assert compiler, "this test needs a C compiler: install one so that 'cc' runs it"
    library = tmp_path / "libmine.so"
    source = ROOT / "materials/template/c/neo_hookean.c"
    header = ROOT / "sim-core/abi/include"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-I", header, source, "-o", library, "-lm"], check=True)
    names = barchan.load_plugin(library)
    assert len(names) == 1 and names[0] in barchan.registry()["materials"]
    press["material"] = [{"name": "snow", "law": names[0], "density": 400.0}]
    simulation = barchan.Simulation(press)
    simulation.act("plate", linear=[0, 0, -0.5])
    simulation.advance(0.1)
    assert simulation.wrenches()["plate"].force[2] > 1.0
    with pytest.raises(barchan.PluginError, match="registered twice"):
        barchan.load_plugin(library)
    with pytest.raises(barchan.PluginError, match="press"):
        (tmp_path / "press.so").write_text("no library")
        barchan.load_plugin(tmp_path / "press.so")


def test_pictures_are_arrays_and_files(press, tmp_path):
    simulation = barchan.Simulation(press, overrides={"output.picture.pixels": 300})
    drawer = view.View(simulation)
    first = drawer.draw(simulation)
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    np.testing.assert_array_equal(first, view.picture(simulation))
    simulation.act("plate", linear=[0.3, 0, -0.5])
    simulation.advance(0.1)
    second = drawer.draw(simulation)
    ground = drawer.draw(simulation, part="ground")
    assert second.shape == first.shape and np.any(second != first)
    assert ground.shape[0] < second.shape[0] and ground.std() > 1.0
    view.save_png(tmp_path / "press.png", second)
    view.save_gif(tmp_path / "press.gif", [first, second])
    view.save_mp4(tmp_path / "press.mp4", (one for one in (first, second, second)))
    assert (tmp_path / "press.mp4").read_bytes()[4:8] == b"ftyp"
    with pytest.raises(ValueError, match="none"):
        view.save_mp4(tmp_path / "empty.mp4", [])
    for path, pictures, error, what in (
        (tmp_path / "nowhere" / "a.mp4", [first], barchan.FileError, "nowhere"),
        (tmp_path / "a.qqq", [first] * 3, ValueError, "ends with .mp4"),
        (tmp_path / "a.mp4", [np.zeros((64, 64), np.uint8)], ValueError, "uint8 of shape"),
        (tmp_path / "a.mp4", [np.zeros((64, 64, 3))], ValueError, "float64"),
    ):
        with pytest.raises(error, match=what):
            view.save_mp4(path, pictures)
    for seconds in (0.0, np.nan):
        with pytest.raises(ValueError, match="seconds"):
            view.save_mp4(tmp_path / "a.mp4", [first], seconds=seconds)
    with pytest.raises(ValueError, match="seconds"):
        view.save_gif(tmp_path / "a.gif", [first], seconds=-1.0)
    with pytest.raises(ValueError, match="one View"):
        view.save_mp4(tmp_path / "two.mp4", [first, ground])
    assert (tmp_path / "press.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (tmp_path / "press.gif").read_bytes()[:6] == b"GIF89a"
    with pytest.raises(barchan.FileError, match="press.png"):
        view.save_png(tmp_path / "none" / "press.png", first)
    with pytest.raises(ValueError, match="rows, columns, 3"):
        view.save_png(tmp_path / "flat.png", first[:, :, :2])


def test_plots_show_what_was_simulated(press, tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    simulation = barchan.Simulation(press)
    axes = view.plot_height_map(simulation)
    assert axes.images[0].get_array().shape == (8, 8)
    ledgers, times = [], []
    for _ in range(3):
        simulation.step(5)
        ledgers.append(simulation.ledger())
        times.append(simulation.time)
    axes = view.plot_ledger(ledgers, times)
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_array_equal(lines["potential"], [one["potential"] for one in ledgers])
    trace = tmp_path / "trace.csv"
    trace.write_text("time [s],step,plate fz [N]\n0.1,1,2.0\n0.2,2,3.0\n")
    axes = view.plot_trace(trace, "plate f*")
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[0.1, 2.0], [0.2, 3.0]])
    with pytest.raises(ValueError, match="plate fz"):
        view.plot_trace(trace, "wheel *")
    pyplot.close("all")


def test_bodies_are_meshes_and_levels_boxes(press):
    press["tool"][0]["shape"] = {"sphere": {"radius": 0.05}}
    press["levels"] = {"count": 2, "half": 8}
    press["world"]["cell"] = 0.0125
    simulation = barchan.Simulation(press)
    (ball,) = simulation.surfaces()
    np.testing.assert_allclose(ball.position, [0.2, 0.2, 0.23])
    np.testing.assert_allclose(np.linalg.norm(ball.triangles, axis=2), 0.05, rtol=0.05)
    (fine,) = simulation.level_boxes()
    assert fine.shape[1:] == (2, 3)
    particles = simulation.particles("level")
    inside = np.all((fine[0, 0] <= particles.position) & (particles.position <= fine[0, 1]), axis=1)
    # Ground is split one coarse cell ahead.
    near = np.all((fine[0, 0] - 0.025 <= particles.position) & (particles.position <= fine[0, 1] + 0.025), axis=1)
    assert inside.any() and np.all(particles.level[inside] == 0) and np.all(near[particles.level == 0])


def test_rerun_is_told_what_there_is(press, monkeypatch):
    told = {}
    kinds = ["Points3D", "Boxes3D", "Transform3D", "Quaternion", "Mesh3D", "Arrows3D"]
    fake = {kind: (lambda *values, kind=kind, **named: (kind, values, named)) for kind in kinds}
    fake["set_time"] = lambda name, duration, recording: told.update({name: duration})
    fake["log"] = lambda name, entity, recording: told.update({(name, entity[0]): entity})
    monkeypatch.setitem(sys.modules, "rerun", types.SimpleNamespace(**fake))
    simulation = barchan.Simulation(press)
    simulation.act("plate", linear=[0, 0, -0.5])
    simulation.advance(0.1)
    view.log_to_rerun(simulation)
    view.log_to_rerun(simulation, colour="level")
    assert told["time"] == 0.1
    _, (places,), named = told["world/particles", "Points3D"]
    assert len(places) == simulation.particle_count == len(named["colors"]) == len(named["radii"])
    assert told["world/bodies/0", "Mesh3D"][2]["vertex_positions"].shape[1] == 3
    np.testing.assert_allclose(told["world/forces", "Arrows3D"][2]["vectors"], [1e-3 * simulation.wrenches()["plate"].force])
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"barchan\[rerun\]"):
        view.log_to_rerun(simulation)


def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    code = "import nbformat, nbclient, sys; nbclient.NotebookClient(nbformat.read(sys.argv[1], 4), timeout=300, kernel_name='python3').execute()"
    notebook = ROOT / "docs/notebooks/first-steps.ipynb"
    done = subprocess.run([sys.executable, "-c", code, notebook], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_example_of_the_package_is_true():
    done = doctest.testmod(barchan)
    assert done.failed == 0 and done.attempted == 4


@pytest.mark.parametrize("file", ["README.md", "bindings/python/README.md"])
def test_the_examples_of_the_readmes_work(file, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / file).read_text(), re.DOTALL)
    assert blocks, f"{file} shows no Python"
    # Those of a page belong together. Nothing is needed but the wheel: neither Rust nor a compiler.
    command = [sys.executable, "-W", "error", "-c", "".join(blocks)]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | {"PATH": ""}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
