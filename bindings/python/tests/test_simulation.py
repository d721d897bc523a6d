"""The class Simulation: what a user can count on."""

import _thread
import copy
import json
import multiprocessing
import os
import pickle
import sys
import threading
import time

import numpy as np
import pytest

import barchan
from barchan import view


def test_a_pressed_block_pushes_back_and_keeps_its_mass(press):
    simulation = barchan.Simulation(press)
    mass = simulation.ledger()["mass"]
    assert mass == pytest.approx(400.0 * 0.2**3, rel=1e-6)
    assert simulation.ledger()["mass"] == pytest.approx(simulation.particles().mass.sum(), rel=1e-6)
    simulation.act("plate", linear=[0, 0, -0.5])
    simulation.advance(0.1)
    assert simulation.time == 0.1
    plate = simulation.bodies()["plate"]
    np.testing.assert_allclose(plate.position, [0.2, 0.2, 0.18], atol=1e-9)
    np.testing.assert_array_equal(plate.velocity, [0, 0, -0.5])
    assert simulation.wrenches()["plate"].force[2] > 1.0
    assert simulation.ledger()["mass"] == pytest.approx(mass, rel=1e-9)


def test_particles_are_copies_of_what_was_asked_for(press):
    simulation = barchan.Simulation(press)
    particles = simulation.particles()
    count = simulation.particle_count
    assert len(particles) == count == len(np.unique(particles.id))
    assert particles.position.shape == (count, 3) and particles.position.dtype == np.float64
    assert particles.velocity.shape == (count, 3) and particles.velocity.dtype == np.float32
    np.testing.assert_allclose(particles.volume0 * 400.0, particles.mass, rtol=1e-5)
    particles.position[:] = 0.0
    assert simulation.particles().position.max() > 0.15
    lower = simulation.particles("mass", region=((0, 0, 0), (1, 1, 0.1)))
    assert 0 < len(lower) < count and lower.position[:, 2].max() <= 0.1
    with pytest.raises(AttributeError, match=r"particles\('velocity'\)"):
        lower.velocity
    with pytest.raises(ValueError, match="no 'speed'.*velocity, affine"):
        simulation.particles("speed")
    with pytest.raises(ValueError, match="region"):
        simulation.particles(region=(0, 0, 0))


def test_particles_of_an_f64_run_are_read_in_f64(press):
    simulation = barchan.Simulation(press, precision="f64")
    simulation.act("plate", linear=[0, 0, -0.5])
    simulation.advance(0.02)
    for particles in [simulation.particles(), simulation.cut(0.2)]:
        assert particles.velocity.dtype == particles.mass.dtype == particles.volume0.dtype == np.float64
        assert particles.id.dtype == np.uint64 and len(np.unique(particles.id)) == len(particles)
    particles = simulation.particles("velocity", "mass", "affine")
    assert np.any(particles.velocity != particles.velocity.astype(np.float32))
    momentum = (particles.mass[:, None] * particles.velocity).sum(axis=0)
    np.testing.assert_allclose(momentum, simulation.ledger()["momentum"], rtol=1e-12, atol=1e-14)
    lower = simulation.particles("mass", region=((0, 0, 0), (1, 1, 0.1)))
    assert 0 < len(lower) < len(particles) and lower.position[:, 2].max() <= 0.1


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_stress_and_strain_can_be_read(press, precision):
    simulation = barchan.Simulation(press, precision=precision)
    simulation.act("plate", linear=[0, 0, -0.5])
    simulation.advance(0.05)
    read = simulation.particles("stress", "density", "strain", "mass", "volume0", "id", "level")
    number = np.dtype(precision.replace("f", "float"))
    assert read.stress.shape == read.strain.shape == (len(read), 6) and read.density.shape == (len(read),)
    assert read.stress.dtype == read.density.dtype == number and read.level.dtype == np.uint8
    # Stretch by volume is det(b) ** 1/2.
    xx, yy, zz, xy, xz, yz = read.strain.T.astype(float)
    ratio = np.sqrt(xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    np.testing.assert_allclose(read.density * read.volume0 * ratio, read.mass, rtol=1e-5)
    cut = simulation.cut(0.2)
    place = {number: i for i, number in enumerate(read.id)}
    same = [place[number] for number in cut.id]
    assert len(same) > 50 and cut.pressure.max() > 10.0
    np.testing.assert_allclose(-read.stress[same, :3].sum(axis=1) / 3, cut.pressure, rtol=1e-4, atol=1e-3)
    # The plate presses what is below it.
    assert read.stress[:, 2].min() < 2.0 * read.stress[:, 0].min() < 0
    with pytest.raises(AttributeError, match=r"particles\('velocity'\)"):
        read.velocity
    with pytest.raises(ValueError, match="no 'speed'.*affine.*stress"):
        simulation.particles("stress", "speed")


def test_a_seed_that_is_given_is_that_of_its_world(press):
    def seeds(**given):
        worlds = barchan.Simulation(press, worlds=2, **given)
        return [int(next(line for line in worlds.scene(world=w).splitlines() if line.startswith("seed")).split("=")[1]) for w in (0, 1)]

    assert seeds(seed=5) == [5, 6] and seeds(seed=[7, 7]) == [7, 7]
    assert seeds(overrides=[{"seed": 3}, {"seed": 3}]) == [3, 3]
    assert seeds(overrides=[{"seed": 3}, {}])[0] == 3 and seeds(overrides={"seed": 3}) == [3, 4]
    with pytest.raises(ValueError, match="world 1"):
        seeds(seed=5, overrides=[{}, {"seed": 3}])
    with pytest.raises(ValueError, match="leave out one"):
        seeds(seed=5, overrides={"seed": 3})
    with pytest.raises(ValueError, match="3 of them for 2 worlds"):
        seeds(seed=[1, 2, 3])


def test_heights_are_those_of_the_block_and_the_floor(press):
    press["body"][0]["sampling"] = "lattice"
    simulation = barchan.Simulation(press)
    ground = simulation.height_map()
    assert ground.heights.shape == (8, 8) == (len(ground.x), len(ground.y))
    inside = (ground.x > 0.1) & (ground.x < 0.3)
    np.testing.assert_allclose(ground.heights[np.ix_(inside, inside)], 0.2, atol=0.01)
    scan = simulation.height_scan([(0.2, 0.2), (0.02, 0.02)])
    np.testing.assert_allclose(scan, [0.2, 0.0], atol=0.01)
    part = simulation.height_map(((0.1, 0.1), (0.3, 0.2)), 0.02)
    assert part.heights.shape == (10, 5) and part.x[0] == pytest.approx(0.11)
    with pytest.raises(ValueError, match="cell"):
        simulation.height_map(cell=0.0)
    with pytest.raises(ValueError, match="16777216 in all"):
        simulation.height_map(cell=1e-5)


def test_heights_of_all_worlds_are_those_of_each(press):
    worlds = barchan.Simulation(press, worlds=3)
    worlds.act("plate", linear=[[0, 0, -0.5], [0, 0, -1.0], [0, 0, -1.5]])
    worlds.step(40)
    points = np.random.default_rng(7).uniform(0.02, 0.38, (3, 6, 2))
    same = worlds.height_arrays(points[0])
    own = worlds.height_arrays(points)
    assert same.shape == own.shape == (3, 6)
    for world in range(3):
        np.testing.assert_array_equal(same[world], worlds.height_scan(points[0], world=world))
        np.testing.assert_array_equal(own[world], worlds.height_scan(points[world], world=world))
    assert np.ptp(same, axis=0).max() > 0.0
    np.testing.assert_array_equal(worlds.height_arrays(points[[2, 0]], worlds=[2, 0]), own[[2, 0]])
    alone = barchan.Simulation(press)
    assert alone.height_arrays(points[0]).shape == (1, 6)
    with pytest.raises(ValueError, match=r"\[2, 6, 2\]; it should be \(n, 2\) for all worlds or \(3, n, 2\)"):
        worlds.height_arrays(points[:2])
    with pytest.raises(IndexError, match="no world 3"):
        worlds.height_arrays(points[0], worlds=3)


def test_chamfer_distances_are_those_of_all_pairs(press):
    simulation = barchan.Simulation(press)
    simulation.step(3)
    particles = simulation.particles("id")
    points = np.random.default_rng(5).uniform(-0.1, 0.5, (40, 3))
    apart = np.linalg.norm(points[:, None] - particles.position[None], axis=-1)
    found = simulation.chamfer(points, material="snow")
    np.testing.assert_allclose(found.distances, apart.min(axis=1), rtol=1e-6)
    np.testing.assert_array_equal(found.ids, particles.id[apart.argmin(axis=1)])
    assert found.distance == pytest.approx(apart.min(axis=0).mean() + apart.min(axis=1).mean(), rel=1e-6)
    none = simulation.chamfer(points, level=3)
    assert np.isnan(none.distance) and np.isnan(none.distances).all()
    assert np.isnan(simulation.chamfer(np.empty((0, 3))).distance)
    with pytest.raises(barchan.UnknownNameError, match="body.*stone"):
        simulation.chamfer(points, body="stone")
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        simulation.chamfer([(0.0, 0.0)])


def test_pressure_in_a_cut_grows_downwards(press):
    press["time"] |= {"end": 1.0}
    press["material"] = [{"name": "m", "law": "neo_hookean", "density": 1000.0, "parameters": {"young_modulus": 1e5}}]
    press["body"][0] = {"material": "m", "shape": {"box": {"min": [0, 0, 0], "max": [0.4, 0.4, 0.2]}}}
    press["world"]["walls"] |= {side: "slip" for side in ("x_min", "x_max", "y_min", "y_max")}
    del press["tool"]
    simulation = barchan.Simulation(press)
    # A column that vibrates about its weight: its mean over some periods is that.
    low = []
    for _ in range(40):
        simulation.advance(0.01)
        cut = simulation.cut(0.19)
        assert np.abs(cut.position[:, 1] - 0.19).max() < 0.5 * 0.025
        low.append(cut.pressure[cut.position[:, 2] < 0.05].mean() - cut.pressure[cut.position[:, 2] > 0.15].mean())
    # Upright stress grows by rho g 0.15 m between the layers; sideways by nu / (1 - nu) of that, with nu of the law's default.
    nu = barchan.registry()["materials"]["neo_hookean"]["parameters"]["poisson_ratio"]["default"]
    expected = 1000.0 * 9.81 * 0.15 * (1 + 2 * nu / (1 - nu)) / 3
    assert np.mean(low) == pytest.approx(expected, rel=0.15)


class Elastic:
    """A compressible neo-Hookean solid: Kirchhoff stress mu (b - I) + lambda ln J I."""

    name = "elastic_in_python"
    parameters = {"young_modulus": (1e5, "Pa"), "poisson_ratio": 0.3}
    states = {"seen": 0.0}

    def moduli(self, batch):
        young, nu = batch.parameters["young_modulus"], batch.parameters["poisson_ratio"]
        return young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))

    def tangent_moduli(self, batch):
        lame, mu = self.moduli(batch)
        less = batch.strain_trial - np.array([1, 1, 1, 0, 0, 0])[:, None]
        mu = mu * (1 + np.sqrt((less[:3] ** 2).sum(axis=0) + 2 * (less[3:] ** 2).sum(axis=0)))
        return np.array([lame + 2 * mu, 3 * lame + 2 * mu])

    def update(self, batch):
        lame, mu = self.moduli(batch)
        xx, yy, zz, xy, xz, yz = batch.strain_trial.astype(float)
        volume = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        batch.kirchhoff = mu * np.array([xx - 1, yy - 1, zz - 1, xy, xz, yz])
        batch.kirchhoff[:3] += 0.5 * lame * np.log(volume)
        batch.state_out += batch.dt > 0


def test_a_push_is_momentum(dog):
    before = dog.robots()["dog"]
    mass = sum(body.mass for name, body in dog.bodies().items() if name.startswith("dog"))
    momentum = lambda: sum(body.mass * body.velocity for name, body in dog.bodies().items() if name.startswith("dog"))
    start = momentum()
    dog.push("dog", [3.0, -1.0, 2.0], angular=[0.0, 0.1, 0.0])
    np.testing.assert_allclose(momentum() - start, [3.0, -1.0, 2.0], atol=1e-9)
    dog.push("dog/FL_foot", [0.5, 0.0, 0.0])
    np.testing.assert_allclose(momentum() - start, [3.5, -1.0, 2.0], atol=1e-9)
    assert mass > 5.0 and not np.array_equal(dog.robots()["dog"].velocity, before.velocity)
    with pytest.raises(barchan.BodyError, match="finite"):
        dog.push("dog", [np.nan, 0, 0])
    with pytest.raises(barchan.BodyError, match="cat"):
        dog.push("cat", [1, 0, 0])
    with pytest.raises(ValueError, match="x, y and z"):
        dog.push("dog", [1, 0])


def test_what_a_plan_warns_of_is_a_warning(press, tmp_path):
    press["tool"][0]["shape"] = {"box": {"half": [0.1, 0.1, 0.01]}}
    with pytest.warns(barchan.BarchanWarning, match="tool 'plate' is 20.000 mm thick") as said:
        simulation = barchan.Simulation(press, worlds=2)
    assert [str(one.message) for one in said] == simulation.plan().warnings
    assert said[0].filename == __file__


def test_motors_take_rates(dog):
    with pytest.raises(barchan.BodyError, match="has kp, and no joint targets"):
        dog.act("dog", joint_rates=np.ones(12))
    stance = dog.robots()["dog"].joint_position
    dog.act("dog", joint_targets=stance, joint_rates=np.zeros(12), joint_torques=np.full(12, 0.1))
    dog.advance(0.01)
    with pytest.raises(TypeError, match="give one command"):
        dog.act("dog", linear=[0, 0, 1], joint_rates=np.ones(12))


def test_a_robot_can_be_put_elsewhere(dog):
    dog.advance(0.01)
    before = dog.robots()["dog"]
    joints = np.tile([0.0, 0.9, -1.7], 4)
    dog.place("dog", position=before.position + [0.1, 0, 0.2], joints=joints, joint_rates=np.zeros(12), velocity=[0, 0, 1])
    after = dog.robots()["dog"]
    np.testing.assert_allclose(after.position - before.position, [0.1, 0, 0.2], atol=1e-12)
    np.testing.assert_array_equal(after.joint_position, joints)
    np.testing.assert_array_equal(after.rotation, before.rotation)
    assert not after.joint_rate.any()
    # A quarter turn about the vertical.
    dog.place("dog", rotation=[0.5**0.5, 0, 0, 0.5**0.5])
    np.testing.assert_allclose(dog.robots()["dog"].rotation, [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-12)
    dog.advance(0.02)
    for wrong, message in [
        ({"position": [np.nan, 0, 0]}, "position"),
        ({"position": [99, 0, 0]}, "outside the world"),
        ({"joints": np.zeros(3)}, "12 joints"),
        ({"joints": np.full(12, 9.0)}, "limits"),
    ]:
        with pytest.raises(barchan.BodyError, match=message):
            dog.place("dog", **wrong)
    with pytest.raises(ValueError, match="w, x, y and z"):
        dog.place("dog", rotation=[1, 0, 0])
    with pytest.raises(TypeError, match="where to put it"):
        dog.place("dog")


def test_torques_of_motors_are_those_of_a_restored_state(dog):
    dog.act("dog", joint_targets=np.tile([0.0, 0.8, -1.6], 4))
    dog.advance(0.05)
    state, torque = dog.state(), dog.robots()["dog"].joint_torque
    dog.advance(0.06)
    assert np.any(dog.robots()["dog"].joint_torque != torque)
    dog.restore(state)
    np.testing.assert_array_equal(dog.robots()["dog"].joint_torque, torque)


def test_materials_may_be_written_in_python(press):
    assert barchan.add_material(Elastic()) == "elastic_in_python"
    described = barchan.registry()["materials"]["elastic_in_python"]
    assert described["parameters"]["young_modulus"]["unit"] == "Pa" and "neo-Hookean" in described["doc"]
    press["time"]["step"] = 5e-4
    both = []
    for law in ("elastic_in_python", "neo_hookean"):
        press["material"] = [{"name": "snow", "law": law, "density": 400.0, "parameters": {"young_modulus": 2e4, "poisson_ratio": 0.25}}]
        simulation = barchan.Simulation(press, precision="f64")
        simulation.act("plate", linear=[0, 0, -0.2])
        simulation.advance(0.1)
        both.append(simulation)
    assert both[0].step_count == both[1].step_count
    python, built_in = (one.particles("velocity", "id") for one in both)
    order = [np.argsort(one.id) for one in (python, built_in)]
    np.testing.assert_allclose(python.position[order[0]], built_in.position[order[1]], atol=1e-9)
    assert built_in.velocity.min() < -0.1 and both[0].wrenches()["plate"].force[2] > 1.0
    with pytest.raises(barchan.PluginError, match="registered twice"):
        barchan.add_material(Elastic())
    with pytest.raises(TypeError, match=r"Elastic is a class; give an object of it, Elastic\(\)"):
        barchan.add_material(Elastic)


def test_what_a_material_in_python_raises_is_told(press):
    class Broken(Elastic):
        name = "broken_in_python"

        def update(self, batch):
            if self.flat:
                batch.kirchhoff = np.zeros(3)
            else:
                raise RuntimeError("no idea")

    law = Broken()
    barchan.add_material(law)
    press["time"]["step"] = 5e-4
    press["material"] = [{"name": "snow", "law": "broken_in_python", "density": 400.0}]
    for law.flat, what in ((False, "RuntimeError: no idea"), (True, "batch.kirchhoff has another shape than")):
        with pytest.raises(barchan.SimulationError, match=what) as caught:
            barchan.Simulation(press).step(2)
        # With the law's own traceback.
        cause = caught.value.__cause__
        assert isinstance(cause, ValueError if law.flat else RuntimeError) and (law.flat or cause.__traceback__ is not None)
    law.update = lambda batch: sys.exit(3)
    with pytest.raises(SystemExit):
        barchan.Simulation(press).step(2)
    # What is no law's has no cause.
    with pytest.raises(barchan.UnknownNameError) as caught:
        barchan.Simulation("digg")
    assert caught.value.__cause__ is None


def test_probes_find_what_the_scene_asks_for(press):
    press["probe"] = [
        {"name": "lower", "within": {"box": {"min": [0, 0, 0], "max": [0.4, 0.4, 0.1]}}},
        {"name": "air", "nearest": [0.2, 0.2, 0.39], "material": "snow"},
    ]
    simulation = barchan.Simulation(press, worlds=2)
    simulation.act("plate", linear=[0, 0, -0.5], worlds=1)
    simulation.advance(0.05)
    for world in range(2):
        found = simulation.probes(world=world)
        particles = simulation.particles("mass", region=((0, 0, 0), (0.4, 0.4, 0.1)), world=world)
        assert list(found) == ["lower", "air"]
        assert found["lower"]["mass [kg]"] == pytest.approx(particles.mass.sum(dtype=float), rel=1e-6)
        assert found["lower"]["particles"] == len(particles)
    assert simulation.probes(world=1)["lower"]["mass [kg]"] > simulation.probes(world=0)["lower"]["mass [kg]"]
    assert barchan.Simulation("dig", overrides={"world.cell": 0.05}).probes() == {}


def test_robots_tell_joints_and_take_targets(dog):
    robot = dog.robots()["dog"]
    scan = dog.scan("dog")
    np.testing.assert_allclose(scan.points, [[x, y] for y in (-0.2, 0.2) for x in (-0.3, 0.0, 0.3)], atol=1e-9)
    np.testing.assert_allclose(scan.heights, -1.0, atol=1e-9)
    with pytest.raises(barchan.BodyError, match="'cat'.*there are dog"):
        dog.scan("cat")
    assert len(robot.joint_names) == 12 and robot.joint_names[2] == "FL_calf_joint"
    dog.act("dog", joint_targets=np.tile([0.0, 0.8, -1.6], 4))
    dog.advance(0.1)
    robot = dog.robots()["dog"]
    assert dog.times[0] == 0.1 and np.all(robot.joint_position[2::3] < -0.1)
    # It falls: an accelerometer reads next to nothing.
    assert robot.projected_gravity[2] < -0.9 and robot.velocity[2] == pytest.approx(-0.981, abs=0.05)
    assert list(robot.links)[0] in dog.bodies()
    with pytest.raises(barchan.BodyError, match="12"):
        dog.act("dog", joint_targets=[0.0])
    with pytest.raises(TypeError, match="one command"):
        dog.act("dog", joint_targets=np.zeros(12), linear=[0, 0, 1])


def test_a_robot_that_lands_says_where_its_links_are_touched(dog):
    dog.place("dog", position=[0.0, 0.0, 0.45])
    assert dog.patches("dog") == {}
    dog.advance(0.4)
    patches = dog.patches("dog", least=2.0)
    links = dog.robots()["dog"].links
    assert patches and set(patches) == {name for name, link in links.items() if (np.linalg.norm(link.contact_forces, axis=1) > 2.0).any()}
    for name, patch in patches.items():
        assert patch.points == len(links[name].contact_points) and (patch.low <= patch.high).all()
        assert (patch.low <= patch.centre_of_pressure).all() and (patch.centre_of_pressure <= patch.high).all()
        assert abs(patch.centre_of_pressure[2]) < 0.01, "the floor is at 0"
    with pytest.raises(barchan.BodyError, match="there are dog"):
        dog.patches("cat")


def test_some_worlds_go_on_while_others_wait(press, same):
    worlds = barchan.Simulation(press, worlds=3, seed=5)
    worlds.advance(0.004, worlds=[0, 2])
    worlds.advance(0.004, worlds=2)
    worlds.advance(0.004, worlds=[])
    np.testing.assert_allclose(worlds.times, [0.004, 0.0, 0.008])
    alone = barchan.Simulation(press, seed=7)
    alone.advance(0.004)
    alone.advance(0.004)
    assert same(worlds, alone, a_world=2)
    with pytest.raises(IndexError, match="3"):
        worlds.advance(0.1, worlds=[3])


def test_arrays_of_all_worlds_hold_what_each_world_tells(dog, press, tmp_path):
    (tmp_path / "fall.toml").write_text(dog.scene())
    worlds = barchan.Simulation(tmp_path / "fall.toml", worlds=3)
    targets = np.tile([0.0, 0.8, -1.6], 4) + np.array([[0.0], [0.1], [0.2]])
    worlds.act("dog", joint_targets=targets)
    worlds.step(5)
    arrays = worlds.robot_arrays("dog", scan=True)
    assert arrays.joint_position.shape == (3, 12) and arrays.felt_force.shape == (3, len(arrays.link_names), 3)
    for world in range(3):
        robot = worlds.robots(world=world)["dog"]
        assert arrays.joint_names == robot.joint_names and arrays.link_names == list(robot.links)
        for name in ("position", "rotation", "velocity", "angular_velocity", "specific_force", "projected_gravity", "joint_position", "joint_rate", "joint_torque"):
            np.testing.assert_array_equal(getattr(arrays, name)[world], getattr(robot, name))
        for link, one in enumerate(robot.links.values()):
            body = worlds.bodies(world=world)[one.name]
            for name in ("position", "rotation", "velocity", "angular_velocity"):
                np.testing.assert_array_equal(getattr(one, name), getattr(body, name))
                np.testing.assert_array_equal(getattr(arrays, f"link_{name}")[world, link], getattr(one, name))
            np.testing.assert_array_equal(arrays.ground_force[world, link], one.ground.force)
            np.testing.assert_array_equal(arrays.ground_torque[world, link], one.ground.torque)
            np.testing.assert_array_equal(arrays.felt_force[world, link], one.felt.force)
            np.testing.assert_array_equal(arrays.felt_torque[world, link], one.felt.torque)
        np.testing.assert_array_equal(arrays.heights[world], worlds.scan("dog", world=world).heights)
    assert np.ptp(arrays.joint_rate, axis=0).max() > 0.0
    some = worlds.robot_arrays("dog", worlds=[2, 0])
    np.testing.assert_array_equal(some.joint_rate, arrays.joint_rate[[2, 0]])
    assert some.heights is None and dog.robot_arrays("dog", scan=True).heights.shape == (1, 6)
    with pytest.raises(barchan.BodyError, match="'cat'.*there are dog"):
        worlds.robot_arrays("cat")
    pressed = barchan.Simulation(press, worlds=2)
    pressed.act("plate", linear=[[0, 0, -0.5], [0, 0, -1.0]])
    pressed.step(40)
    plates = pressed.body_arrays("plate")
    for world in range(2):
        body, wrench = pressed.bodies(world=world)["plate"], pressed.wrenches(world=world)["plate"]
        for name in ("position", "rotation", "velocity", "angular_velocity", "mass"):
            np.testing.assert_array_equal(getattr(plates, name)[world], getattr(body, name))
        np.testing.assert_array_equal(plates.force[world], wrench.force)
        np.testing.assert_array_equal(plates.torque[world], wrench.torque)
    assert np.all(plates.force[:, 2] > 0.0)
    with pytest.raises(barchan.BodyError, match="there are plate"):
        pressed.body_arrays("plates")


def test_worlds_act_reset_and_go_on_as_they_do_alone(press, same):
    worlds = barchan.Simulation(press, worlds=3, seed=5)
    speeds = np.array([[0, 0, -0.1], [0, 0, -0.3], [0, 0, -0.5]])
    worlds.act("plate", linear=speeds)
    worlds.advance(0.05)
    np.testing.assert_array_equal(worlds.times, 0.05)
    for world in range(3):
        alone = barchan.Simulation(press, seed=5 + world)
        alone.act("plate", linear=speeds[world])
        alone.advance(0.05)
        assert same(worlds, alone, a_world=world)
    assert not same(worlds, worlds, a_world=0, b_world=1)
    worlds.reset(1)
    np.testing.assert_array_equal(worlds.times, [0.05, 0.0, 0.05])
    assert same(worlds, barchan.Simulation(press, seed=6), a_world=1)
    worlds.reset([0, 2], seeds=[9, 9])
    assert same(worlds, worlds, a_world=0, b_world=2)
    assert same(worlds, barchan.Simulation(press, seed=9))
    worlds.step(7)
    worlds.copy_world(1, [0])
    assert same(worlds, worlds, a_world=0, b_world=1)
    with pytest.raises(IndexError, match="no world 3"):
        worlds.bodies(world=3)
    with pytest.raises(ValueError, match="a row for each of 3"):
        worlds.act("plate", linear=np.zeros((2, 3)))
    # No world is told anything where one is told what cannot be.
    worlds.act("plate", linear=np.zeros(3))
    heights = worlds.body_arrays("plate").position[:, 2]
    for wrong in (np.nan, 1e40):
        with pytest.raises(barchan.BodyError, match="world 1") as refused:
            worlds.act("plate", linear=[[0, 0, -0.5], [0, 0, wrong], [0, 0, 0]])
        assert refused.value.world == 1
    worlds.step(3)
    np.testing.assert_array_equal(worlds.body_arrays("plate").position[:, 2], heights)
    # A mask is not numbers of worlds.
    for mask in ([False, True, False], True):
        with pytest.raises(TypeError, match="flatnonzero"):
            worlds.reset(mask)
    with pytest.raises(ValueError, match="2 of them for 3"):
        worlds.reset(seeds=[1, 2])
    with pytest.raises(barchan.CapacityError, match="worlds"):
        barchan.Simulation(press, worlds=10**9)
    with pytest.raises(ValueError, match="2\\^63 - 1"):
        worlds.reset(seeds=[1, 2, 2**63])
    with pytest.raises((TypeError, ValueError), match="2\\^63 - 1"):
        barchan.Simulation(press, seed=-1)


def test_worlds_may_differ_in_what_their_scenes_say(press, same):
    densities = [300.0, 400.0, 500.0]
    each = [{"material.snow.density": density} for density in densities]
    worlds = barchan.Simulation(press, worlds=3, seed=5, overrides=each)
    masses = [worlds.ledger(world=world)["mass"] for world in range(3)]
    np.testing.assert_allclose(masses, np.array(densities) * masses[1] / 400.0, rtol=1e-6)
    worlds.step(9)
    for world in range(3):
        alone = barchan.Simulation(press, seed=5 + world, overrides=each[world])
        alone.step(9)
        assert same(worlds, alone, a_world=world)
    # From an episode to the next.
    worlds.reset([2, 0], overrides=[{"tool.plate.position": [0.2, 0.2, 0.3]}, {"material.snow.density": 200.0}])
    assert worlds.body_arrays("plate").position[:, 2].tolist() == [0.23, 0.23, 0.3]
    assert worlds.times[0] == worlds.times[2] == 0.0 < worlds.times[1]
    assert same(worlds, barchan.Simulation(press, seed=5, overrides={"material.snow.density": 200.0}))
    assert "density = 500.0" in worlds.scene(world=2) and "density = 200.0" in worlds.scene()
    with pytest.raises(ValueError, match="2 for 3 worlds"):
        barchan.Simulation(press, worlds=3, overrides=each[:2])
    with pytest.raises(TypeError, match="a dict for each world"):
        barchan.Simulation(press, worlds=3, overrides=3)
    worlds.step(2)
    before = worlds.times.tolist()
    with pytest.raises(barchan.SceneError, match="density"):
        worlds.reset(overrides=[{}, {}, {"material.snow.density": -1.0}])
    # Nor does any begin anew where only the making of a world tells that it cannot be.
    with pytest.raises(barchan.UnknownNameError, match="world 1: overrides: material.0..law") as refused:
        worlds.reset(overrides=[{}, {"material.snow.law": "nope"}, {}])
    assert refused.value.world == 1
    assert worlds.times.tolist() == before and min(before) > 0.0
    one = barchan.Simulation(press)
    one.reset(overrides={"time.end": 0.7, "name": "other"})
    assert one.end == 0.7 and one.name == "other"
    with pytest.raises(barchan.UnknownNameError, match="^scene: material.0..law"):
        barchan.Simulation(press | {"material": [{"name": "snow", "law": "nope", "density": 400.0}]})


def test_states_forks_and_files_go_on_bit_for_bit(press, same, tmp_path):
    simulation = barchan.Simulation(press, precision="f64")
    simulation.act("plate", linear=[0, 0, -0.3])
    simulation.step(10)
    state, fork = simulation.state(), simulation.fork()
    simulation.save(tmp_path / "here.barchan")
    loaded = barchan.Simulation.load(tmp_path / "here.barchan")
    simulation.step(10)
    fork.step(10)
    loaded.step(10)
    assert loaded.precision == "f64" and loaded.step_count == 20
    assert same(simulation, fork) and same(simulation, loaded)
    again = barchan.Simulation(press, precision="f64")
    again.restore(copy.deepcopy(state))
    assert again.step_count == 10 == state.step_count
    with pytest.raises(TypeError, match="State cannot be pickled"):
        pickle.dumps(state)
    again.step(10)
    assert same(simulation, again)
    with pytest.raises(barchan.BodyError, match="f64"):
        barchan.Simulation(press).restore(state)
    # Worlds have seeds of their own, and take over a state's, as does one that begins anew.
    worlds = barchan.Simulation(press, precision="f64", worlds=3, seed=4)
    worlds.restore(state)
    worlds.step(10)
    assert all(same(worlds, simulation, a_world=world) for world in range(3))
    second = worlds.state(world=1)
    worlds.reset(1, seeds=[99])
    worlds.restore(second, worlds=1)
    assert same(worlds, simulation, a_world=1) and worlds.times[1] == worlds.times[0]
    again.reset(seeds=99)
    again.restore(state)
    again.step(10)
    assert same(simulation, again)
    # A file's state fits worlds of the same scene, whatever is drawn of them.
    saved = barchan.Simulation.load(tmp_path / "here.barchan").state()
    drawn = barchan.Simulation(press, precision="f64", worlds=2, overrides={"output.picture.pixels": 92, "output.picture.view": "perspective", "time.end": 3.0})
    drawn.restore(saved)
    drawn.step(10)
    assert all(same(drawn, simulation, a_world=world) for world in range(2))
    assert view.View(drawn).draw(drawn, part="ground").shape[1] == 64
    with pytest.raises(barchan.BodyError, match="another scene: world.cell"):
        barchan.Simulation(press, precision="f64", worlds=2, overrides={"world.cell": 0.04}).restore(state)
    with pytest.raises(barchan.FileError, match="missing.barchan"):
        barchan.Simulation.load(tmp_path / "missing.barchan")
    with pytest.raises(barchan.SnapshotError):
        (tmp_path / "wrong.barchan").write_bytes(b"no snapshot")
        barchan.Simulation.load(tmp_path / "wrong.barchan")


def test_a_swap_keeps_time_and_particles(press):
    simulation = barchan.Simulation(press)
    simulation.step(5)
    before = simulation.particles("id")
    simulation.swap("cpu", precision="f64")
    assert simulation.precision == "f64" and simulation.step_count == 5
    after = simulation.particles("id")
    order = [np.argsort(one.id) for one in (before, after)]
    np.testing.assert_allclose(before.position[order[0]], after.position[order[1]], atol=1e-7)
    with pytest.raises(barchan.UnknownNameError, match="abacus.*cpu") as caught:
        simulation.swap("abacus")
    assert "cpu" in caught.value.known
    simulation.step(5)
    assert simulation.step_count == 10


def test_the_plan_the_ledger_and_the_clock_say_what_runs(press):
    simulation = barchan.Simulation(press)
    plan = simulation.plan()
    assert any("snow" in name for name in plan.effects) and "effect" in str(plan)
    assert plan.particle_count == simulation.particle_count and plan.cell_widths == [0.05]
    simulation.step(3)
    assert sum(simulation.timing().values()) > 0.0
    assert json.dumps(simulation.ledger())
    assert repr(simulation).startswith("<barchan.Simulation of 'press'") and "step 3, cpu f32" in repr(simulation)
    assert 'name = "press"' in simulation.scene()


def test_scenes_come_by_name_file_and_dict_and_take_overrides(press, same, tmp_path):
    simulation = barchan.Simulation(press, overrides={"world.cell": 0.04, "tool.plate.position": (0.2, 0.2, 0.3)})
    assert simulation.plan().cell_widths == [0.04] and simulation.bodies()["plate"].position[2] == 0.3
    file = tmp_path / "press.toml"
    file.write_text(simulation.scene())
    assert same(simulation, barchan.Simulation(file)) and same(simulation, barchan.Simulation(str(file)))
    assert "dig" in barchan.scenes()
    dig = barchan.Simulation("dig", overrides={"world.cell": 0.05})
    assert dig.name == "dig" and dig.end == 1.8


def test_errors_say_what_where_and_how_to_mend_it(press, tmp_path):
    with pytest.raises(barchan.UnknownNameError, match="'digg'.*dig") as caught:
        barchan.Simulation("digg")
    assert isinstance(caught.value, barchan.BarchanError) and isinstance(caught.value, LookupError)
    press["body"][0]["shape"]["box"]["min"] = [0.1, 0.1]
    with pytest.raises(barchan.SceneError) as caught:
        barchan.Simulation(press)
    assert caught.value.path.startswith("body[0].shape") and caught.value.line is None
    file = tmp_path / "wrong.toml"
    file.write_text('name = "wrong"\n\n[wurld]\n')
    with pytest.raises(barchan.SceneError, match="wrong.toml:3") as caught:
        barchan.Simulation(file)
    assert caught.value.line == 3
    with pytest.raises(barchan.SceneError, match="overrides"):
        barchan.Simulation("dig", overrides={"world.cell": -1.0})
    with pytest.raises(TypeError, match="set"):
        barchan.Simulation({"name": {1}})
    with pytest.raises(TypeError, match="int"):
        barchan.Simulation(3)
    with pytest.raises(ValueError, match="f32 or f64"):
        barchan.Simulation("dig", precision="f16")
    with pytest.raises(barchan.FileError, match="nowhere.toml"):
        barchan.Simulation(tmp_path / "nowhere.toml")
    with pytest.raises(TypeError, match="world.cel: None is no value of a scene; leave the key out"):
        barchan.Simulation("dig", overrides={"world.cel": None})
    with pytest.raises(barchan.SceneError, match="seed: 9223372036854775808 does not fit"):
        barchan.Simulation("dig", overrides={"seed": 2**63})
    of_itself: dict = {"name": "ring"}
    of_itself["world"] = of_itself
    with pytest.raises(barchan.SceneError, match="does one hold itself"):
        barchan.Simulation(of_itself)
    with pytest.raises(ValueError, match="finite"):
        barchan.Simulation("dig", overrides={"world.cell": 0.05}).height_scan([[np.nan, 0.1]])


def test_what_cannot_be_meant_is_refused_by_its_name(press, tmp_path):
    s = barchan.Simulation(press)
    one = np.zeros((1, 3))
    for error, said, ask in [
        (TypeError, "(?s)-1 is no whole number from 0 on.*'world'", lambda: s.particles(world=-1)),
        (TypeError, "(?s)True is no whole number.*'count'", lambda: s.step(True)),
        (TypeError, "(?s)-1 is no whole number.*'threads'", lambda: barchan.Simulation(press, threads=-1)),
        (ValueError, r"points: the number at \[0, 0\] is NaN", lambda: s.height_scan([[np.nan, 0.1]])),
        (ValueError, r"points: the number at \[1, 1\] is inf", lambda: s.height_arrays([[0.1, 0.1], [0.1, np.inf]])),
        (ValueError, r"points: the number at \[0, 2\] is NaN", lambda: s.chamfer([[0.1, 0.1, np.nan]])),
        (ValueError, "region: it goes from .* give its least corner first", lambda: s.particles(region=((1, 1, 1), (0, 0, 0)))),
        (ValueError, "region: it goes from .*NaN", lambda: s.height_map(((np.nan, 0), (1, 1)))),
        (ValueError, "region: its shape is", lambda: s.height_map((0, 1))),
        (ValueError, "at: NaN is no place of a plane", lambda: s.cut(np.nan)),
        (barchan.BodyError, "particle 0 comes twice", lambda: s.set_particles([0, 0], velocity=np.zeros((2, 3)))),
        (barchan.BodyError, "there is no particle 99999999", lambda: s.set_particles([99999999], velocity=one)),
        (barchan.BodyError, "another place with a number of 1.000e30 is asked for", lambda: s.place("plate", velocity=[0, 0, 1e30])),
        (barchan.BodyError, "a twist with a number of 2.000e15 is asked for", lambda: s.act("plate", linear=[0, 0, -2e15])),
        (ValueError, "picture: it is an array of float64", lambda: view.save_png(tmp_path / "a.png", np.zeros((4, 4, 3)))),
        (ValueError, "seeds: there are 2 of them for 1 worlds", lambda: s.reset(seeds=[1, 2])),
    ]:
        with pytest.raises(error, match=said):
            ask()
    s.step()
    with pytest.raises(ValueError, match="seconds: 1e-300 is too short"):
        s.record(1e-300)
    # Nothing of it has changed anything.
    again = barchan.Simulation(press)
    again.step()
    assert np.array_equal(s.particles().position, again.particles().position)


def test_a_state_that_one_world_refuses_leaves_all_as_they_are(press, same):
    worlds = barchan.Simulation(press, worlds=2, overrides=[{}, {"gravity": [0.0, 0.0, -1.0]}])
    start = worlds.state()
    worlds.step(5)
    before = worlds.fork()
    with pytest.raises(barchan.BodyError, match="another scene: gravity"):
        worlds.restore(start)
    assert worlds.step_count == 5 and same(worlds, before)


def test_seeds_count_from_a_number(press):
    worlds = barchan.Simulation(press, worlds=3, seed=4)
    first = [worlds.particles(world=world).position for world in range(3)]
    worlds.reset(seeds=5)
    assert np.array_equal(worlds.particles(world=0).position, first[1]) and np.array_equal(worlds.particles(world=1).position, first[2])


def test_a_world_that_cannot_go_on_says_which_and_why(press):
    press["time"]["step"] = 1e-3
    worlds = barchan.Simulation(press, worlds=2)
    # Far more than a cell a step.
    worlds.act("plate", linear=[0, 0, -500.0], worlds=1)
    with pytest.raises(barchan.SimulationError, match="^world 1: time step 1.000e-3 s.*above the bound") as caught:
        worlds.step(3)
    assert caught.value.world == 1 and worlds.times[1] == 0.0
    # The other one goes on as far as it was to go.
    before = worlds.times[0]
    with pytest.raises(barchan.SimulationError, match="^world 1: ") as caught:
        worlds.advance(0.05)
    np.testing.assert_allclose(worlds.times, [before + 0.05, 0.0], atol=1e-12)
    with pytest.raises(barchan.BodyError, match="nan|NaN|finite"):
        worlds.act("plate", linear=[0, 0, np.nan])
    # What no later step could heal is not even tried.
    with pytest.raises(barchan.BodyError, match="a twist with a number of 1.000e40 is asked for"):
        worlds.act("plate", linear=[0, 0, 1e40])


def test_worlds_of_a_gpu_end_at_one_time_and_agree_with_the_processor(press):
    assert barchan.adapters() and barchan.adapters("cpu") == []
    press["time"]["step"] = 5e-4
    worlds, alone = barchan.Simulation(press, backend="wgpu", worlds=2, seed=5), barchan.Simulation(press, seed=6)
    for simulation in (worlds, alone):
        simulation.act("plate", linear=[0, 0, -0.5])
        simulation.advance(0.03)
        simulation.advance(0.02)
    np.testing.assert_allclose(worlds.times, 0.05, rtol=1e-12)
    ours, theirs = worlds.particles("id", world=1), alone.particles("id")
    ours, theirs = (one.position[np.argsort(one.id)] for one in (ours, theirs))
    # Steps are the same, and rounding is not.
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    worlds.copy_world(0, [1])
    np.testing.assert_array_equal(worlds.bodies(world=0)["plate"].position, worlds.bodies(world=1)["plate"].position)
    with pytest.raises(ValueError, match="fork"):
        worlds.swap("cpu")
    alone.swap("wgpu")
    alone.step(2)
    assert alone.backend == "wgpu"


def test_ctrl_c_ends_a_long_call_between_two_steps(press):
    simulation = barchan.Simulation(press)
    threading.Timer(0.3, _thread.interrupt_main).start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        simulation.advance(1e5)
    assert time.monotonic() - begun < 20.0
    reached = simulation.step_count
    assert reached > 0
    simulation.step()
    assert simulation.step_count == reached + 1


def test_other_threads_run_during_a_step_and_may_not_disturb_it(press):
    simulation = barchan.Simulation(press)
    worker = threading.Thread(target=simulation.step, args=(6_000,))
    worker.start()
    # A thread that runs meanwhile sees that it is at work.
    while "busy" not in repr(simulation):
        assert worker.is_alive()
    with pytest.raises(barchan.BusyError, match="another thread"):
        simulation.particles("mass")
    worker.join()
    assert simulation.step_count == 6_000


def count_steps(scene):
    simulation = barchan.Simulation(scene)
    simulation.step(2)
    return simulation.step_count


def test_it_is_not_pickled_but_works_in_other_processes(press):
    with pytest.raises(TypeError, match="save"):
        pickle.dumps(barchan.Simulation(press))
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(count_steps, (press,)) == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_is_told_that_it_has_no_threads(press):
    simulation = barchan.Simulation(press, threads=1)
    with multiprocessing.get_context("fork").Pool(1, initializer=inherit, initargs=(simulation,)) as pool:
        said = pool.apply_async(use_inherited).get(timeout=60)
    assert "forked" in said and "spawn" in said
    simulation.advance(0.002)


def inherit(simulation):
    global inherited
    inherited = simulation


def use_inherited():
    try:
        inherited.particles()
    except barchan.BusyError as error:
        return str(error)
