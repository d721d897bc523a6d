"""Tapes and gradients in Python: shapes, names, chaining, refusals."""

import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import barchan

JELLY = {
    "name": "drop",
    "world": {"cell": 0.05, "min": [0, 0, 0], "max": [0.6, 0.4, 0.6], "walls": {"z_min": "stick"}},
    "time": {"end": 1.0, "step": 1e-3},
    "sleep": {"on": False},
    "material": [{"name": "jelly", "law": "neo_hookean", "density": 1000, "parameters": {"young_modulus": 2e4}}],
    "body": [{"material": "jelly", "shape": {"box": {"min": [0.1, 0.1, 0.02], "max": [0.3, 0.3, 0.2]}}, "velocity": [0.3, 0, -1]}],
}


def drop(young_modulus=2e4):
    return barchan.Simulation(JELLY, precision="f64", overrides={"material.jelly.parameters.young_modulus": young_modulus})


def test_a_gradient_is_the_derivative_by_a_parameter():
    def height(young_modulus):
        simulation = drop(young_modulus)
        simulation.advance(0.06)
        return simulation.particles().position[:, 2].mean()

    tape = drop().record(0.06)
    count = len(tape.end)
    assert len(tape) == 60 and tape.start.position.shape == (count, 3)
    np.testing.assert_allclose(tape.dt, np.full(60, 1e-3), rtol=1e-9)
    assert tape.end.mass.sum() == pytest.approx(1000 * 0.2 * 0.2 * 0.18, rel=0.05) and not tape.end.body.any()
    np.testing.assert_array_equal(tape.start.id, tape.end.id)
    assert tape.end.position[:, 2].mean() == pytest.approx(height(2e4), abs=1e-15)
    up = np.zeros((count, 3))
    up[:, 2] = 1 / count
    gradient = tape.pull_back(position=up)
    expected = (height(2e4 + 2) - height(2e4 - 2)) / 4
    assert gradient.parameters["jelly"]["young_modulus"] == pytest.approx(expected, rel=1e-5)
    assert gradient.position.shape == gradient.velocity.shape == (count, 3) and gradient.gravity.shape == (3,)
    # All of it moves along as it starts further to a side.
    assert gradient.position[:, 2].sum() < 1 and gradient.position.flags.writeable
    assert set(gradient.parameters["jelly"]) == {"young_modulus", "poisson_ratio"}


def pushed(motion, **more):
    """Jelly that a ball is pushed into."""
    ball = {"name": "ball", "shape": {"sphere": {"radius": 0.08}}, "position": [0.21, 0.19, 0.27], "contact": {"coulomb": {"friction": 0.4}}, "motion": motion}
    body = {**JELLY["body"][0], "velocity": [0, 0, 0]}
    return barchan.Simulation({**JELLY, "body": [body], "tool": [{**ball, **more}]}, precision="f64")


def difference(loss, step):
    return (loss(step) - loss(-step)) / (2 * step)


def test_gradients_by_tools_are_derivatives_of_what_they_do_and_feel():
    def run(speed, spin=0.0, height=0.0):
        simulation = pushed({"velocity": {}}, position=[0.21, 0.19, 0.27 + height])
        simulation.act("ball", linear=[0.2, 0, -0.8 + speed], angular=[0, 3 + spin, 0])
        tape = simulation.record(0.02)
        felt = tape.impulses["ball"]
        return tape, tape.end.position[:, 0].sum() + 3 * felt.impulse[2] + 5 * felt.angular_impulse[1]

    tape, _ = run(0.0)
    assert tape.impulses["ball"].impulse[2] > 0.01
    right = np.zeros((len(tape.end), 3))
    right[:, 0] = 1
    owed = {"ball": {"impulse": [0, 0, 3], "angular_impulse": (0, 5, 0)}}
    gradient = tape.pull_back(position=right, bodies=owed).bodies["ball"]
    assert gradient.keyframes.shape == (0, 3) and gradient.rotation.shape == (3,)
    for given, changed, step in [
        (gradient.linear[2], lambda by: run(by)[1], 1e-4),
        (gradient.angular[1], lambda by: run(0, by)[1], 1e-3),
        (gradient.position[2], lambda by: run(0, 0, by)[1], 1e-6),
    ]:
        assert given == pytest.approx(difference(changed, step), rel=1e-4)


def test_gradients_by_commands_chain_and_end_where_a_tool_ends():
    simulation = pushed({"velocity": {}})
    tapes = []
    for speed in (-0.9, -0.3):
        simulation.act("ball", linear=[0, 0, speed])
        tapes.append(simulation.record(0.01))
    # However fast it goes, it ends where its ways add up to.
    last = tapes[1].pull_back(bodies={"ball": {"position": [0, 0, 1]}})
    first = tapes[0].pull_back(then=last)
    for gradient in (first, last):
        np.testing.assert_allclose(gradient.bodies["ball"].linear, [0, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(first.bodies["ball"].position, [0, 0, 1], atol=1e-12)
    # A loss may look at how fast it is told to be.
    np.testing.assert_array_equal(tapes[1].pull_back(bodies={"ball": {"velocity": [0, 0, 1]}}).bodies["ball"].linear, [0, 0, 1])
    # A tool that is elsewhere by then breaks the chain.
    simulation.place("ball", position=[0.2, 0.2, 0.4])
    moved = simulation.record(0.01).pull_back(bodies={"ball": {"position": [0, 0, 1]}})
    with pytest.raises(ValueError, match="then: "):
        tapes[1].pull_back(then=moved)


def test_a_tape_takes_its_steps_again_with_the_shapes_that_it_had(tmp_path):
    def cube(half):
        corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
        faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
        (tmp_path / "cube.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {a} {b} {c} {d}\n" for a, b, c, d in faces))

    def slope(changed):
        cube(0.07)
        simulation = pushed({"velocity": {"linear": [0, 0, -0.8]}}, shape={"mesh": {"file": str(tmp_path / "cube.obj")}})
        if changed:
            cube(0.03)
        return simulation.record(0.02).pull_back(bodies={"ball": {"impulse": [0, 0, 1]}}).bodies["ball"].linear

    assert slope(False)[2] != 0
    np.testing.assert_array_equal(slope(True), slope(False))


def test_gradients_by_keyframes_are_derivatives():
    def run(by):
        frames = [{"time": 0, "position": [0.2, 0.2, 0.28]}, {"time": 0.015, "position": [0.21 + by, 0.2, 0.26]}, {"time": 0.03, "position": [0.22, 0.2, 0.25]}]
        tape = pushed({"keyframes": {"frames": frames}}).record(0.02)
        return tape, tape.impulses["ball"].impulse[0]

    gradient = run(0.0)[0].pull_back(bodies={"ball": {"impulse": [1, 0, 0]}}).bodies["ball"]
    assert gradient.keyframes.shape == (3, 3) and not gradient.position.any()
    assert gradient.keyframes[1, 0] == pytest.approx(difference(lambda by: run(by)[1], 1e-6), rel=1e-4)


def test_gradients_by_a_ball_that_is_thrown_are_derivatives():
    def run(speed, mass=1.0):
        tape = pushed({"free": {"mass": mass, "linear": [0.3, 0, speed], "angular": [0, 4, 0]}}).record(0.02)
        return tape, tape.impulses["ball"].impulse[2]

    tape, _ = run(-1.0)
    gradient = tape.pull_back(bodies={"ball": {"impulse": [0, 0, 1]}}).bodies["ball"]
    assert gradient.velocity[2] == pytest.approx(difference(lambda by: run(-1.0 + by)[1], 1e-4), rel=1e-4)
    assert gradient.mass == pytest.approx(difference(lambda by: run(-1.0, 1.0 + by)[1], 1e-4), rel=1e-4)
    assert not gradient.linear.any() and gradient.force == 0.0
    # It lands on the ground's wall, which is no part of what gradients go through.
    for speed, height in [(-1, 0.09), (0.02, 0.078)]:
        lands = pushed({"free": {"mass": 1.0, "linear": [0, 0, speed]}}, position=[0.5, 0.2, height]).record(0.03)
        with pytest.raises(barchan.BodyError, match="a wall of the world has pushed it"):
            lands.pull_back(bodies={"ball": {"position": [0, 0, 1]}})


def test_what_makes_no_sense_of_tools_is_refused():
    with pytest.raises(barchan.BodyError, match="tool 'ball'.*leave out from and until"):
        pushed({"velocity": {}}, until=0.5).record(0.01)
    tape = pushed({"velocity": {"linear": [0, 0, -1]}}).record(0.004)
    for owed, says in [
        ({"cube": {"position": [0, 0, 1]}}, "there is no 'cube'; there are: ball"),
        ({"ball": {"speed": [0, 0, 1]}}, "no derivative by 'speed'"),
        ({"ball": {"position": [0, 1]}}, "it takes x, y and z"),
    ]:
        with pytest.raises(ValueError, match=says):
            tape.pull_back(bodies=owed)
    with pytest.raises(barchan.BodyError, match="not a finite number"):
        tape.pull_back(bodies={"ball": {"impulse": [0, 0, np.nan]}})


def test_gradients_by_particles_are_derivatives_by_what_set_particles_changes():
    noise = np.random.default_rng(3)
    way = noise.uniform(-1, 1, (len(drop().particles()), 3))

    def height(moved=0.0, faster=0.0):
        simulation = drop()
        start = simulation.particles()
        order = np.argsort(start.id)
        id, position = start.id[order], start.position[order]
        velocity = np.tile([0.3, 0.0, -1.0], (len(id), 1))
        simulation.set_particles(id, position=position + moved * way, velocity=velocity + faster * way)
        tape = simulation.record(0.03)
        return tape, tape.end.position[:, 2].sum()

    tape, _ = height()
    up = np.zeros_like(tape.end.position)
    up[:, 2] = 1
    gradient = tape.pull_back(position=up)
    assert (gradient.position * way).sum() == pytest.approx(difference(lambda by: height(moved=by)[1], 1e-7), rel=1e-5)
    assert (gradient.velocity * way).sum() == pytest.approx(difference(lambda by: height(faster=by)[1], 1e-6), rel=1e-5)


def test_particles_that_cannot_be_set_stay_as_they_are():
    simulation = drop()
    before = simulation.particles()
    first = before.id[:1]
    for id, given, says in [
        ([10**9], {"velocity": [[0, 0, 1]]}, "no particle 1000000000"),
        ([first[0], first[0]], {"velocity": np.zeros((2, 3))}, "comes twice"),
        (first, {"position": [[0, 0, 9]]}, "outside the world"),
        (first, {"velocity": [[0, np.inf, 0]]}, "not finite"),
        (first, {"velocity": [[0, 1e39, 0]]}, "beyond 1e15"),
        (first, {"position": [[np.nan, 0, 0]]}, "outside the world"),
    ]:
        with pytest.raises(barchan.BodyError, match=says):
            simulation.set_particles(id, **given)
    for given, says in [({}, "nothing is to be changed"), ({"velocity": [0, 0, 1]}, r"\(1, 3\)")]:
        with pytest.raises(ValueError, match=says):
            simulation.set_particles(first, **given)
    np.testing.assert_array_equal(simulation.particles().position, before.position)
    simulation.set_particles(first, affine=[range(9)])
    after = simulation.particles("id", "affine")
    np.testing.assert_array_equal(after.affine[after.id == first[0]], [range(9)])


def test_tapes_chain_and_losses_may_look_at_both():
    whole = drop().record(0.05)
    up = np.ones((len(whole.end), 3))
    both = drop()
    first, second = both.record(0.02), both.record(0.03)
    assert both.time == pytest.approx(0.05) and len(first) + len(second) == len(whole)
    later = second.pull_back(position=up, velocity=0.1 * up)
    chained = first.pull_back(then=later)
    direct = whole.pull_back(position=up, velocity=0.1 * up)
    np.testing.assert_allclose(chained.velocity, direct.velocity, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(chained.gravity, direct.gravity, rtol=1e-9)
    for name, value in direct.parameters["jelly"].items():
        assert chained.parameters["jelly"][name] == pytest.approx(value, rel=1e-9)
    with pytest.raises(ValueError, match="record one tape behind the other"):
        second.pull_back(then=later)
    # What the loss owes to the middle is added.
    looked = first.pull_back(position=up, then=later)
    alone = first.pull_back(position=up)
    np.testing.assert_allclose(looked.position, chained.position + alone.position, rtol=1e-9, atol=1e-12)


def test_a_body_that_spins_owes_to_its_affine_matrices_too():
    def height(spin):
        simulation = barchan.Simulation(JELLY, precision="f64", overrides={"body[0].angular_velocity": [0, spin, 0]})
        tape = simulation.record(0.03)
        return tape.end.position[:, 2] @ tape.end.position[:, 0], tape

    loss, tape = height(0.5)
    x, v = tape.end.position, np.zeros((len(tape.end), 3))
    v[:, 0], v[:, 2] = x[:, 2], x[:, 0]
    gradient = tape.pull_back(position=v)
    arm = tape.start.position - tape.start.position.mean(axis=0)
    axis = np.array([0, 1.0, 0])
    # Velocity is the spin times the arm, and C the matrix of the same product.
    spin = np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0.0]])
    found = (np.cross(axis, arm) * gradient.velocity).sum() + (gradient.affine.reshape(-1, 3, 3) * spin).sum()
    assert found == pytest.approx((height(0.5 + 1e-4)[0] - height(0.5 - 1e-4)[0]) / 2e-4, rel=1e-5)


def test_gradients_go_through_levels_whose_particles_split():
    ball = {"name": "ball", "shape": {"sphere": {"radius": 0.05}}, "position": [0.5, 0.45, 0.45], "contact": "stick", "motion": {"velocity": {"linear": [16, 0, 0]}}}
    scene = {
        **JELLY,
        "world": {"cell": 0.05, "min": [0, 0, 0], "max": [2.2, 1.0, 0.7], "walls": {"z_min": "stick", "x_max": "slip"}},
        "levels": {"count": 2, "half": 8},
        "body": [{"material": "jelly", "shape": {"box": {"min": [0.02, 0.02, 0], "max": [2.2, 0.9, 0.3]}}, "velocity": [0.3, 0, -0.4]}],
        "tool": [ball],
    }

    def moment(speed=0.0, **where):
        simulation = barchan.Simulation(scene, precision="f64", **where)
        start = simulation.particles()
        faster = start.velocity + [0.0, 0.0, speed] * start.position[:, :1]
        simulation.set_particles(start.id, velocity=faster)
        tape = simulation.record(0.03)
        return tape.end.mass @ tape.end.position[:, 2], tape

    _, tape = moment()
    assert len(tape.end) > len(tape.start) and tape.end.mass.sum() == pytest.approx(tape.start.mass.sum(), rel=1e-12)
    loss = np.zeros((len(tape.end), 3))
    loss[:, 2] = tape.end.mass
    gradient = tape.pull_back(position=loss)
    assert gradient.velocity.shape == tape.start.position.shape
    found = gradient.velocity[:, 2] @ tape.start.position[:, 0]
    assert found == pytest.approx(difference(lambda by: moment(by)[0], 1e-4), rel=1e-5)


def test_worlds_of_a_batch_are_recorded_one_by_one():
    worlds = barchan.Simulation(JELLY, worlds=3, precision="f64")
    tape = worlds.record(0.02, world=1)
    np.testing.assert_allclose(worlds.times, [0, 0.02, 0])
    up = np.ones((len(tape.end), 3))
    np.testing.assert_array_equal(tape.pull_back(position=up).velocity, drop().record(0.02).pull_back(position=up).velocity)
    with pytest.raises(IndexError, match="no world 3"):
        worlds.record(0.02, world=3)


def test_what_cannot_be_is_refused_by_name(press):
    levels = barchan.Simulation(press, overrides={"sleep.on": False, "levels.count": 2, "levels.subcycle": True})
    with pytest.raises(barchan.BodyError, match="levels.subcycle.*set it to false"):
        levels.record(0.01)
    with pytest.raises(barchan.PluginError, match="sleep.on = false"):
        barchan.Simulation(JELLY, overrides={"sleep.on": True}).record(0.01)
    with pytest.raises(ValueError, match="seconds"):
        drop().record(0)
    tape = drop().record(0.005)
    with pytest.raises(TypeError, match="give position, velocity, bodies, robots or then"):
        tape.pull_back()
    cotangent = np.zeros_like(tape.end.position)
    cotangent[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"position: the number at \[2, 1\] is NaN"):
        tape.pull_back(position=cotangent)
    with pytest.raises(AttributeError, match="'stress' was not read; a Simulation reads it"):
        _ = tape.end.stress
    with pytest.raises(ValueError, match=r"position.*\(\d+, 3\)"):
        tape.pull_back(position=np.zeros((3, 3)))
    for unpicklable in [tape, tape.pull_back(position=np.zeros((len(tape.end), 3)))]:
        with pytest.raises(TypeError, match="cannot be pickled"):
            pickle.dumps(unpicklable)
    assert "5 steps" in repr(tape)


def test_robots_have_gradients_by_joint():
    scene = {
        "name": "fall",
        "world": {"cell": 0.05, "min": [-1, -1, 0], "max": [1, 1, 2]},
        "time": {"end": 1.0, "step": 1e-3},
        "robot": [{"name": "dog", "model": "quadruped", "position": [0, 0, 1], "motor": [{"kp": 50, "kd": 2}]}],
    }
    simulation = barchan.Simulation(scene, precision="f64")
    simulation.act("dog", joint_targets=np.full(12, 0.1))
    tape = simulation.record(0.02)
    gradient = tape.pull_back(bodies={"dog": {"velocity": [0, 0, 1]}})
    # Nothing holds it: all of it falls, whatever its joints do, but its base moves against its legs.
    assert gradient.gravity[2] == pytest.approx(0.02, abs=1e-6)
    dog = gradient.robots["dog"]
    assert dog.positions.shape == dog.targets.shape == dog.kd.shape == (12,)
    assert np.abs(dog.targets).max() > 1e-4
    with pytest.raises(ValueError, match="robots: there is no 'cat'; there are: dog"):
        tape.pull_back(robots={"cat": {"positions": np.zeros(12)}})
    with pytest.raises(ValueError, match=r"robots: dog: rates: the shape is \[1, 12\]; give a number for each of its 12 joints"):
        tape.pull_back(robots={"dog": {"rates": np.zeros((1, 12))}})
    with pytest.raises(ValueError, match="has no derivative by 'torques'"):
        tape.pull_back(robots={"dog": {"torques": np.zeros(12)}})
    with pytest.raises(TypeError, match="robots: give a dict by names"):
        tape.pull_back(robots={"dog": [1.0]})


@pytest.mark.parametrize("example", [0, 1, 2])
def test_the_examples_of_the_documentation_find_what_they_look_for(example):
    text = (Path(__file__).resolve().parents[3] / "docs" / "gradients.md").read_text()
    # What needs PyTorch is among the tests of the extra `learn`.
    blocks = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "torch" not in block]
    assert len(blocks) == 3
    done = subprocess.run([sys.executable, "-W", "error", "-c", blocks[example]], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
