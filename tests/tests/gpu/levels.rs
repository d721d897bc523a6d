//! Levels: rims, what follows agents, rounds of split and merge, ground that comes within reach.

use super::{apart, cpu, followed, gpu, left, off, on, on_gpu, passes_of, take, take_at_once};
use barchan::scene::{Leaving, Scene, Shape, Wall};
use barchan::worlds::Worlds;
use barchan::{Command, Ledger, Options, Precision, Simulation, Vec3};
use barchan_tests::long_cases::{FURROW_CELL, furrow_depth, furrow_scene};
use barchan_tests::scenes::{Noise, Row, alter, change_of_linear_field, norm, rows, scene, within};
use barchan_tests::sketch::{Head, block, body, driven, half, material, tool};

/// Sand that a blade throws out of an open side, on two levels which follow the blade: none is lost from the account while particles split, merge
/// and leave; with steps for all levels and of their own, driven and beside a free cube.
#[test]
fn levels_lose_particles_too() {
    for (subcycle, cube, leaving) in
        [(false, false, Leaving::Delete), (true, true, Leaving::Delete), (true, false, Leaving::Clamp)]
    {
        println!("subcycled: {subcycle}, with a cube: {cube}, {leaving:?}");
        let mut scene = followed(1, subcycle, cube);
        scene.world.leaving = leaving;
        scene.world.walls.x_max = Wall::Open;
        scene.world.max[0] = 1.28;
        scene.body[0].velocity[0] = 3.0;
        scene.body[0].shape =
            Shape::Box { min: Some([0.16, 0.0, 0.0]), max: Some([1.28, 0.48, 0.16]), center: None, half: None };
        let mut sim = Simulation::new(&barchan::registry(), &scene, &on_gpu()).unwrap();
        let before = sim.ledger();
        take_at_once(&mut sim, 45);
        let now = sim.ledger();
        println!("{:?}", now.counts);
        assert!(now.counts["particles that changed level"] > 0, "{:?}", now.counts);
        within("mass there is and was", ((now.mass + now.deleted_mass) / before.mass - 1.0).abs(), 1e-5);
        assert_eq!(now.particles as usize, sim.particle_count());
        match leaving {
            Leaving::Delete => assert!(now.deleted_mass > 0.02 * before.mass, "{}", now.deleted_mass),
            _ => assert!(now.counts["particles put back into the world"] > 0 && now.deleted_mass == 0.0),
        }
    }
}

/// Levels around a tool that stands aside and touches nothing.
fn around_marker(count: u32, half: u32, at: Vec3) -> String {
    format!("[levels]\ncount = {count}\nhalf = {half}\nagents = [\"marker\"]\n")
        + &tool("marker", at, "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\"")
}

/// A block of jelly cut by rims at x = 0.2 and z = 0.3 on so many levels.
pub(super) fn cut(count: u32, sampling: &str) -> String {
    let h = 0.05;
    Head { gravity: [0.0; 3], ..Head::space(h) }.time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-0.2; 3], [0.8; 3], &format!("sampling = \"{sampling}\"")),
        around_marker(count, 8, [0.2 - 8.0 * h, -0.2 - 3.0 * h, 0.3 - 8.0 * h]),
    ])
}

/// Symptom guarded against: rims that take the mean affine matrix of particles where these were sorted, and not where they are. Balls that each spin their own way fly through a rim,
/// before any is sorted again: velocities are those of the CPU.
#[test]
fn balls_that_spin_fly_through_a_rim_as_on_the_cpu() {
    let h = 0.02;
    let mut noise = Noise::new(3);
    let mut ball = |n: u32| {
        let [x, y, z] = [n / 9, n / 3 % 3, n % 3].map(f64::from);
        let center: Vec3 = [(14.3, x), (6.3, y), (6.2, z)].map(|(from, k)| h * (from + 1.05 * k));
        let spin: Vec3 = std::array::from_fn(|_| 60.0 * noise.draw());
        let moves = format!("spacing = 0.0068\nvelocity = [5.0, 0.0, 0.0]\nangular_velocity = {spin:?}");
        body("fixed_corotated", &format!("sphere = {{ center = {center:?}, radius = 0.0103 }}"), &moves)
    };
    let mut parts = vec![
        "[levels]\ncount = 2\nhalf = 8\nbox = [{ min = [0.08, 0.08, 0.08], max = [0.24, 0.24, 0.24] }]\n".to_owned(),
        material("fixed_corotated", 1600.0, "young_modulus = 1.0"),
    ];
    parts.extend((0..36).map(&mut ball));
    let text = Head { gravity: [0.0; 3], ..Head::cells(h, [24; 3], "") }.time("step = 2e-4").with(&parts);
    let [host, device] = [cpu(&text), gpu(&text)].map(|mut sim| {
        take(&mut sim, 8);
        rows(&sim)
    });
    let through = host.iter().filter(|row| row.x[0] > 18.0 * h).count();
    assert!(through > 20 && host.len() == device.len(), "{through} of {} are through", host.len());
    let most = host.iter().zip(&device).map(|(a, b)| off(a.v, b.v)).fold(0.0, f64::max);
    within("velocities", most, 2e-5);
}

/// Symptom guarded against: a rim whose restriction, affine term or prolongation is off. Physics: v = a + B x with C = B on particles at
/// random places with random masses comes back after a step, on both sides of rims.
#[test]
fn affine_fields_are_reproduced_at_rims() {
    let a = [0.3, -0.2, 0.1];
    let b = [0.2, -0.4, 0.3, 0.1, -0.3, 0.5, -0.6, 0.2, 0.1];
    let mut patch = gpu(&cut(3, "jitter"));
    let mut noise = Noise::new(11);
    alter(&mut patch, |r| {
        r.v = std::array::from_fn(|i| a[i] + (0..3).map(|j| b[3 * i + j] * r.x[j]).sum::<f64>());
        r.c = b;
        r.m *= 1.0 + 0.9 * noise.draw();
    });
    let before = rows(&patch);
    take(&mut patch, 1);
    let mut worst = [(0, 0f64, 0f64); 3];
    for (old, new) in before.iter().zip(&rows(&patch)) {
        let worst = &mut worst[new.level as usize];
        worst.0 += 1;
        worst.1 = (0..3).fold(worst.1, |w, i| w.max((new.v[i] - old.v[i]).abs()));
        worst.2 = (0..9).fold(worst.2, |w, i| w.max((new.c[i] - b[i]).abs()));
    }
    for (level, (count, v, c)) in worst.into_iter().enumerate() {
        assert!(count > 100, "level {level} has {count} particles");
        within(&format!("affine patch, level {level}: v [m/s]"), v, 2e-5);
        within(&format!("affine patch, level {level}: C [1/s]"), c, 2e-4);
    }
}

/// Symptom guarded against: passes for each level's own steps, or over levels whose step it is not, which take a device microseconds each however
/// little they do. Three levels, four steps of the finest in one of the coarsest: each of the four is one pass of each kind.
#[test]
fn levels_that_step_together_share_their_passes() {
    let mut block = gpu(&cut(3, "jitter").replace("[levels]", "[levels]\nsubcycle = true"));
    take(&mut block, 8);
    let of_slots: Vec<_> = block.timings().into_iter().filter(|t| t.passes >= 4 * 8).collect();
    let mut names: Vec<_> = of_slots.iter().map(|t| t.effect.as_str()).collect();
    names.sort_unstable();
    assert_eq!(names, ["G2P", "P2G", "contact", "grid", "impulse", "press", "solve"]);
    // A submission that is stopped by its sort is written again.
    assert!(of_slots.iter().all(|t| t.passes <= 2 * 4 * 8), "{of_slots:?}");
}

/// A block that swings across rims on three levels, no particle of which comes to where another level begins: as on the CPU in 64 bits, and
/// momentum and spin are kept.
#[test]
fn a_block_swings_across_rims_as_on_the_cpu() {
    let swing = |sim: &mut Simulation| {
        alter(sim, |r| {
            let k = 4.0;
            r.v = std::array::from_fn(|d| 0.05 * (k * r.x[(d + 1) % 3]).sin());
            r.c = [0.0; 9];
            (0..3).for_each(|d| r.c[3 * d + (d + 1) % 3] = 0.05 * k * (k * r.x[(d + 1) % 3]).cos());
        });
    };
    for subcycle in [false, true] {
        let steps = if subcycle { 50 } else { 200 };
        let toml = cut(3, "lattice").replace("[levels]", &format!("[levels]\nsubcycle = {subcycle}"));
        println!("subcycled: {subcycle}");
        let (mut gpu, mut cpu) = (gpu(&toml), cpu(&toml));
        swing(&mut gpu);
        swing(&mut cpu);
        let (start, before) = (gpu.ledger(), rows(&cpu));
        take(&mut gpu, steps);
        take(&mut cpu, steps);
        within("difference of time [s]", (gpu.time() - cpu.time()).abs(), 1e-12);
        println!("{:?}", cpu.ledger().counts);
        let moved = apart(&before, &rows(&cpu)) / 0.05;
        println!("particles have moved by up to {moved:.3} cells");
        assert!(moved > 0.05, "nothing has happened");
        within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.05, 1e-3);
        let (g, c) = (gpu.ledger(), cpu.ledger());
        let scale = (2.0 * start.kinetic * start.mass).sqrt();
        within("change of momentum", off(g.momentum, start.momentum) / scale, 1e-5);
        println!("spin at start {:?}, on the CPU afterwards {:?}", start.angular_momentum, c.angular_momentum);
        within(
            "change of angular momentum beside the CPU's",
            off(g.angular_momentum, c.angular_momentum) / scale,
            1e-5,
        );
        within("kinetic energy", (g.kinetic / c.kinetic - 1.0).abs(), 1e-3);
    }
}

/// Symptom guarded against: steps of one length for as long as a block falls that was at rest when they were chosen, until its particles move further in
/// one than blocks have room for: an error, after other steps where somebody looked after each. Physics: free fall.
#[test]
fn a_block_that_falls_on_levels_keeps_to_steps_that_it_bears() {
    let toml = Head { gravity: [0.0, 0.0, -9.81], ..Head::space(0.05) }.with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-0.2; 3], [0.8; 3], ""),
        around_marker(3, 8, [-0.2, -0.35, -0.1]).replace("[levels]", "[levels]\nsubcycle = true"),
    ]);
    let (mut sim, mut looked_at) = (gpu(&toml), gpu(&toml));
    take_at_once(&mut sim, 40);
    take(&mut looked_at, 40);
    assert!(left(&sim) == left(&looked_at), "other bits where somebody looks");
    let (ledger, time) = (sim.ledger(), sim.time());
    println!("{time} s, {:?} kg m/s", ledger.momentum);
    assert!(time > 0.2, "40 steps in {time} s");
    within("speed beside free fall", (ledger.momentum[2] / (ledger.mass * -9.81 * time) - 1.0).abs(), 1e-4);
}

/// Likewise where rims meet a slip wall, whose mirror is part of every sum: what the mirror image continues comes back.
#[test]
fn affine_fields_are_reproduced_where_rims_meet_walls() {
    for axis in 0..3 {
        let wall = format!("{}_min = \"slip\"", ["x", "y", "z"][axis]);
        let mut at = [-0.15; 3];
        at[axis] = 0.1;
        let head = Head { gravity: [0.0; 3], ..Head::cells(0.05, [32; 3], &wall) };
        let head = Head { min: std::array::from_fn(|d| if d == axis { 0.0 } else { -0.2 }), ..head };
        let mut patch = gpu(&head.time("step = 1e-3").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [1.6; 3], "sampling = \"jitter\""),
            around_marker(3, 8, at),
        ]));
        let mut b = [0.2, -0.4, 0.3, 0.1, -0.3, 0.5, -0.6, 0.2, 0.1];
        (0..3).filter(|d| *d != axis).for_each(|d| (b[3 * d + axis], b[3 * axis + d]) = (0.0, 0.0));
        for (level, (count, v)) in change_of_linear_field(&mut patch, axis, b).into_iter().enumerate() {
            assert!(count > 100, "level {level} has {count} particles");
            within(&format!("affine patch at a wall across {axis}, level {level}: v [m/s]"), v, 2e-5);
        }
    }
}

/// A tool that dips into a bed of jelly on three levels that meet its floor, beside a plate that is pushed through all of them: places, forces
/// and the floor's impulse as on the CPU, driven many steps at once, and free, one by one; and the same bits again.
#[test]
fn tools_and_walls_meet_levels_as_on_the_cpu() {
    let h = 0.05;
    let push = driven([0.0, 0.1, 0.0]);
    let bed = |motion: &str, subcycle: bool| {
        Head::cells(h, [32, 32, 32], "z_min = \"stick\"").time("step = 1e-3").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [1.6, 1.6, 0.6], ""),
            format!("[levels]\ncount = 3\nhalf = 8\nagents = [\"foot\"]\nsubcycle = {subcycle}\n"),
            tool("foot", [0.2, 0.2, 0.7], &half([0.1, 0.1, 0.11]), "{ coulomb = { friction = 0.3 } }", motion),
            tool("plate", [0.8, 0.5, 0.4], &half([0.7, 0.1, 0.15]), "\"slip\"", &push),
        ])
    };
    let free = "{ free = { mass = 20.0, linear = [0.0, 0.0, -0.1] } }";
    let driven = driven([0.1, 0.0, -0.2]);
    for (motion, subcycle, at_once) in
        [(driven.as_str(), false, 50), (&driven, true, 12), (free, false, 1), (free, true, 1)]
    {
        let bed = |motion: &str| bed(motion, subcycle);
        let steps = if subcycle { 12 } else { 50 };
        let run = |sim: &mut Simulation| {
            let (mut impulses, mut taken) = ([[0.0; 3]; 2], 0);
            while taken < steps {
                for report in sim.steps(at_once.min(steps - taken), f64::INFINITY).unwrap_or_else(|e| panic!("{e}")) {
                    let wrenches = report.wrenches.unwrap_or_else(|| sim.wrenches());
                    for (impulse, wrench) in impulses.iter_mut().zip(wrenches) {
                        (0..3).for_each(|d| impulse[d] += wrench.force[d] * report.dt);
                    }
                    taken += 1;
                }
            }
            impulses
        };
        let (mut g, mut c) = (gpu(&bed(motion)), cpu(&bed(motion)));
        let start = c.ledger();
        let (on_gpu, on_cpu) = (run(&mut g), run(&mut c));
        println!("{motion}, subcycled: {subcycle}: impulse {on_gpu:?} and {on_cpu:?} N s, {:?}", c.ledger().counts);
        within("distance of particles, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-3);
        for (tool, (on_gpu, on_cpu)) in ["foot", "plate"].into_iter().zip(on_gpu.into_iter().zip(on_cpu)) {
            within(&format!("impulse on the {tool}, relative"), off(on_gpu, on_cpu) / norm(on_cpu), 1e-3);
        }
        within("place of the tool, in cells", off(g.bodies()[0].position, c.bodies()[0].position) / h, 1e-3);
        let (gl, cl) = (g.ledger(), c.ledger());
        within("impulse of walls, relative", off(gl.wall_impulse, cl.wall_impulse) / norm(cl.gravity_impulse), 1e-4);
        let gave = |l: &Ledger, tool: Vec3| -> Vec3 {
            std::array::from_fn(|d| {
                l.momentum[d] - start.momentum[d] - l.wall_impulse[d] - l.gravity_impulse[d] + tool[d]
            })
        };
        let both = |tools: [Vec3; 2]| std::array::from_fn(|d| tools[0][d] + tools[1][d]);
        // Symptom guarded against: subcycled, a tool that gives to a node of two levels what both of them weigh, of which the coarser one's
        // particles alone take theirs. It was 4 % of gravity's impulse.
        within("balance of momentum", norm(gave(&gl, both(on_gpu))) / norm(gl.gravity_impulse), 1e-5);
        within("balance of momentum on the CPU", norm(gave(&cl, both(on_cpu))) / norm(cl.gravity_impulse), 1e-12);
        let mut again = gpu(&bed(motion));
        run(&mut again);
        assert!(again.particles().lists == g.particles().lists, "two runs differ");
    }
}

/// Where a free body alone meets levels that take steps of their own, nodes behind mirrors are found in its pass; where ground may sleep, by a pass of
/// their own after contact. Rims of both finer levels meet walls here, which stand within blocks of nodes of the coarser two: the same bits both ways, what the
/// body, the ground and the walls get as on the CPU, and momentum is accounted for. The body stands so that no node is as near to one of its faces as to another.
#[test]
fn mirrors_found_with_rims_are_those_found_later() {
    let h = 0.05;
    let walls = "z_min = \"stick\"\nx_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"stick\"";
    let bed = |beside: &str| {
        Head::cells(h, [36, 36, 32], walls).time("step = 1e-3").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [1.8, 1.8, 0.6], "velocity = [0.06, 0.04, 0.0]"),
            "[levels]\ncount = 3\nhalf = 8\nagents = [\"foot\"]\nsubcycle = true\n".to_owned(),
            tool(
                "foot",
                [0.357, 0.411, 0.703],
                &half([0.1, 0.1, 0.11]),
                "{ coulomb = { friction = 0.3 } }",
                "{ free = { mass = 20.0 } }",
            ),
            beside.to_owned(),
        ])
    };
    let sleepy = "[sleep]\non = true\n";
    let run = |mut sim: Simulation| {
        let (steps, mut taken, mut impulse) = (12, 0, [0.0; 3]);
        while taken < steps {
            for report in sim.steps(steps - taken, f64::INFINITY).unwrap_or_else(|e| panic!("{e}")) {
                let wrenches = report.wrenches.unwrap_or_else(|| sim.wrenches());
                (0..3).for_each(|d| impulse[d] += wrenches[0].force[d] * report.dt);
                taken += 1;
            }
        }
        (sim, impulse)
    };
    let start = cpu(&bed("")).ledger();
    let ((early, on_gpu), (late, _), (cpu, on_cpu)) = (run(gpu(&bed(""))), run(gpu(&bed(sleepy))), run(cpu(&bed(""))));
    assert_eq!(passes_of(&early, "reflect"), 0);
    assert!(passes_of(&late, "reflect") >= 4 * 12);
    assert!(early.particles().lists == late.particles().lists, "found later, they are others");
    println!("impulse on the foot {on_gpu:?} and {on_cpu:?} N s, {:?}", cpu.ledger().counts);
    assert!(
        early.ledger().counts.is_empty(),
        "backends may change levels at different times: {:?}",
        early.ledger().counts
    );
    within("distance of particles, in cells", apart(&rows(&early), &rows(&cpu)) / h, 1e-3);
    within("impulse on the foot, relative", off(on_gpu, on_cpu) / norm(on_cpu), 1e-3);
    within("place of the foot, in cells", off(early.bodies()[0].position, cpu.bodies()[0].position) / h, 1e-3);
    let (el, ll, cl) = (early.ledger(), late.ledger(), cpu.ledger());
    let scale = norm(cl.wall_impulse);
    within("impulse of walls, relative", off(el.wall_impulse, cl.wall_impulse) / scale, 1e-4);
    within("impulse of walls found later, relative", off(el.wall_impulse, ll.wall_impulse) / scale, 1e-5);
    // A second free body near a wall has all contact on the host, in the midst of each step.
    let near_wall =
        tool("ball", [0.06, 1.5, 1.4], "sphere = { radius = 0.01 }", "\"slip\"", "{ free = { mass = 0.01 } }");
    let (host, on_host) = run(gpu(&bed(&near_wall)));
    assert!(passes_of(&host, "gather") >= 4 * 12 && passes_of(&host, "reflect") >= 4 * 12);
    within("distance of particles with the host, in cells", apart(&rows(&early), &rows(&host)) / h, 1e-5);
    within("impulse on the foot with the host, relative", off(on_gpu, on_host) / norm(on_cpu), 1e-4);
    within("impulse of walls with the host, relative", off(el.wall_impulse, host.ledger().wall_impulse) / scale, 1e-5);
    let gave: Vec3 = std::array::from_fn(|d| {
        el.momentum[d] - start.momentum[d] - el.wall_impulse[d] - el.gravity_impulse[d] + on_gpu[d]
    });
    println!("walls gave {:?} N s, balance {gave:?}", el.wall_impulse);
    // Gravity moves the foot as well.
    within("balance of momentum", norm([gave[0], gave[1], 0.0]) / scale, 1e-5);
}

/// Symptom guarded against: a rim that reads what stands behind a wall that lets go before it has been decided what that is; particles there lose
/// momentum that no wall has taken. A block that slides over such a floor, tips and presses on such a side, cut by the rims of three levels
/// that meet both: places and impulses as on the CPU, and momentum is accounted for.
#[test]
fn walls_that_let_go_meet_levels_as_on_the_cpu() {
    let h = 0.05;
    let walls =
        "z_min = { separate = { friction = 0.2 } }\nx_min = { separate = { friction = 0.1 } }\ny_min = \"slip\"";
    let head = Head { gravity: [0.0, 0.0, -1.0], ..Head::cells(h, [32, 32, 32], walls) };
    let toml = head.time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
        block(
            "neo_hookean",
            [0.0; 3],
            [1.5, 0.8, 0.3],
            "velocity = [-0.2, 0.3, -0.1]\nangular_velocity = [0.0, 1.0, 0.0]",
        ),
        around_marker(3, 12, [0.1, 0.1, 0.5]),
    ]);
    let (mut many, mut g, mut c) = (gpu(&toml), gpu(&toml), cpu(&toml));
    let start = c.ledger();
    take(&mut g, 15);
    take(&mut c, 15);
    within("distance before any has changed level, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-5);
    take(&mut g, 85);
    take(&mut c, 85);
    take_at_once(&mut many, 100);
    println!("{:?}", c.ledger().counts);
    let (gl, cl) = (g.ledger(), c.ledger());
    println!("impulse of walls {:?} and {:?} N s", gl.wall_impulse, cl.wall_impulse);
    let balance = |l: &Ledger| -> f64 {
        norm(std::array::from_fn::<f64, 3, _>(|d| {
            l.momentum[d] - start.momentum[d] - l.wall_impulse[d] - l.gravity_impulse[d]
        })) / norm(l.wall_impulse)
    };
    within("balance of momentum on the CPU", balance(&cl), 1e-12);
    within("balance of momentum", balance(&gl), 1e-5);
    within("impulse of walls, relative", off(gl.wall_impulse, cl.wall_impulse) / norm(cl.wall_impulse), 2e-3);
    let moved = rows(&c).iter().map(|r| r.x[2]).fold(0.0, f64::max) - 0.3;
    assert!(moved > 0.5 * h, "it does not tip: {moved} m");
    within("distance of particles, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-2);
    within("distance if many steps are taken at once, in cells", apart(&rows(&many), &rows(&g)) / h, 1e-4);
}

/// A blade drawn through sand, which its levels follow: particles split ahead of it and merge behind, on the host between steps; the same
/// drag, surface and count of particles as on the CPU, with and without subcycling.
#[test]
fn levels_follow_a_tool_as_on_the_cpu() {
    for subcycle in [false, true] {
        let h = 0.02;
        let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
        let toml = Head::cells(h, [48, 20, 24], walls).time("safety = 0.5").with(&[
            material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
            block("sand", [0.0; 3], [0.96, 0.4, 0.24], ""),
            format!("[levels]\ncount = 2\nhalf = 8\nagents = [\"blade\"]\nsubcycle = {subcycle}\n"),
            tool(
                "blade",
                [0.3, 0.2, 0.26],
                &half([0.03, 0.06, 0.08]),
                "{ coulomb = { friction = 0.3 } }",
                &driven([0.8, 0.0, 0.0]),
            ),
        ]);
        let run = |sim: &mut Simulation| {
            let mut impulse = [0.0; 3];
            while sim.time() < 0.15 {
                for report in sim.steps(64, 0.15).unwrap_or_else(|e| panic!("{e}")) {
                    let wrench = report.wrenches.map_or_else(|| sim.wrenches()[0], |wrenches| wrenches[0]);
                    (0..3).for_each(|d| impulse[d] += wrench.force[d] * report.dt);
                }
            }
            impulse
        };
        let (mut g, mut c) = (gpu(&toml), cpu(&toml));
        let before = c.ledger();
        let (on_gpu, on_cpu) = (run(&mut g), run(&mut c));
        println!("subcycled: {subcycle}; impulse {on_gpu:?} and {on_cpu:?} N s");
        println!("{:?}\n{:?}", g.ledger().counts, c.ledger().counts);
        within("impulse on the blade, relative", off(on_gpu, on_cpu) / norm(on_cpu), 0.02);
        let (gl, cl) = (g.ledger(), c.ledger());
        within("mass", (gl.mass / before.mass - 1.0).abs(), 1e-6);
        let count = |l: &Ledger| l.particles as f64;
        let happened = |what: &str| gl.counts.get(what).is_some_and(|count| *count > 0);
        assert!(happened("particles split") && happened("particles merged"), "{:?}", gl.counts);
        within("count of particles, relative", (count(&gl) / count(&cl) - 1.0).abs(), 0.05);
        let depths = |sim: &Simulation| -> Vec<f64> {
            let mut depths = vec![0.0; 24 * 10];
            for r in rows(sim) {
                let at = |x: f64, n: usize| ((x / 0.04) as usize).min(n - 1);
                depths[at(r.x[0], 24) * 10 + at(r.x[1], 10)] += r.volume0 / 0.04f64.powi(2);
            }
            depths
        };
        let (a, b) = (depths(&g), depths(&c));
        let mean = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.len() as f64;
        within("mean difference of depths, in cells", mean / h, 0.05);
        let balance: Vec3 = std::array::from_fn(|d| {
            gl.momentum[d] - before.momentum[d] - gl.wall_impulse[d] - gl.gravity_impulse[d] + on_gpu[d]
        });
        within("balance of momentum", norm(balance) / norm(gl.gravity_impulse), 1e-3);
    }
}

/// A ball of jelly that flies past a block, under gravity; levels follow it, and an eye beside it if there is one. It flies at another speed in
/// each world; a cube may fall, too.
fn thrown(world: u64, subcycle: bool, eye: bool, cube: bool) -> Scene {
    let agents = if eye { "[\"eye\", \"ball\"]" } else { "[\"ball\"]" };
    let mut parts = vec![
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        format!(
            "[[body]]\nname = \"ball\"\nmaterial = \"neo_hookean\"\nvelocity = [{:?}, 0.0, 0.0]\n\
             shape = {{ sphere = {{ center = [-0.9, 0.0, 0.5], radius = 0.12 }} }}\n",
            8.0 + 0.5 * world as f64
        ),
        block("neo_hookean", [-0.8, -0.1, -0.1], [0.0, 0.1, 0.2], ""),
        format!("[levels]\ncount = 3\nhalf = 8\nagents = {agents}\nsubcycle = {subcycle}\n"),
    ];
    if eye {
        let motion = driven([-1.0, 0.0, 0.0]);
        parts.push(tool("eye", [0.8, 0.0, 0.2], "sphere = { radius = 0.05 }", "\"slip\"", &motion));
    }
    if cube {
        let free = "{ free = { mass = 2.0, linear = [0.0, 0.0, -0.5] } }";
        parts.push(tool("cube", [-0.2, 0.0, 0.29], &half([0.08; 3]), "{ coulomb = { friction = 0.3 } }", free));
    }
    scene(
        &Head { gravity: [0.0, 0.0, -9.81], ..Head::space(0.05) }
            .time(if subcycle { "step = 5e-4" } else { "step = 1e-3" })
            .with(&parts),
    )
}

/// Symptom guarded against: a soft body that levels should follow leaves its fine region, or levels that move when the host happens to look.
/// The ball is fine wherever it flies, its boxes stand where the CPU has them, and steps taken at once, one by one, and in a batch of worlds that
/// fly at other speeds are the same bits; with steps of each level's own, beside a driven agent, and with a free cube.
#[test]
fn levels_follow_soft_bodies() {
    let registry = barchan::registry();
    for (subcycle, eye, cube) in [(true, true, false), (false, false, true)] {
        println!("subcycled: {subcycle}, with an eye: {eye}, with a cube: {cube}");
        let scene = |world| thrown(world, subcycle, eye, cube);
        let count = if subcycle { 40 } else { 80 };
        let on_cpu = Options { precision: Precision::F64, threads: 1, ..Options::default() };
        let mut g = Simulation::new(&registry, &scene(0), &on_gpu()).unwrap();
        let mut c = Simulation::new(&registry, &scene(0), &on_cpu).unwrap();
        let before = g.ledger();
        let (mut coarse, mut unlike, mut boxes) = (0, 0, Vec::new());
        // A subcycled step is four.
        let at_once = if subcycle { 1 } else { 4 };
        for _ in 0..count / at_once {
            take(&mut g, at_once);
            take(&mut c, at_once);
            let coarser = |list: &barchan::ParticleList| list.level > 0 && list.body.contains(&0);
            coarse += g.particles().lists.iter().filter(|list| coarser(list)).count();
            let [there, here] = [&g, &c].map(|sim| sim.particles().levels.unwrap().boxes);
            unlike += usize::from(there != here);
            boxes.push(there);
        }
        boxes.dedup();
        let (after, there) = (g.ledger(), c.ledger());
        println!("{} places of boxes; {:?}", boxes.len(), after.counts);
        assert!(boxes.len() > 3 && after.counts["particles split"] > 50, "{:?}", after.counts);
        within("its particles on coarse levels at any time", coarse as f64, 0.0);
        within("times at which boxes are not where the CPU has them", unlike as f64, 0.0);
        within("mass", (after.mass / before.mass - 1.0).abs(), 1e-6);
        within("momentum beside the CPU's", off(after.momentum, there.momentum) / norm(there.momentum), 1e-4);

        let mut worlds = Worlds::new(&registry, (0..2).map(scene).collect(), &on_gpu()).unwrap();
        let mut taken = 0;
        while taken < count {
            let reports = worlds.steps((count - taken).min(50));
            taken += reports.into_iter().map(|reports| reports.unwrap().len()).min().unwrap();
        }
        assert!(left(worlds.world(0)) == left(&g), "a batch is something else");
        let mut alone = Simulation::new(&registry, &scene(1), &on_gpu()).unwrap();
        let mut taken = 0;
        while taken < count {
            taken += alone.steps((count - taken).min(30), f64::INFINITY).unwrap_or_else(|e| panic!("{e}")).len();
        }
        assert!(left(worlds.world(1)) == left(&alone), "world 1 is not itself alone");
    }
}

/// A ball that draws a furrow through settled sand of which only what is around it is live, and comes back through the air: tiles come and go as on
/// the CPU, the ball finds the furrow that it left, mass and momentum are accounted for, and steps taken at once, one by one and after the run
/// was saved go on alike.
#[test]
fn ground_comes_within_reach_and_leaves_it_as_on_the_cpu() {
    let registry = barchan::registry();
    let scene = scene(&furrow_scene(5.12, 0.64).replace("safety = 0.5", "step = 5e-4"));
    let on_cpu = Options { precision: Precision::F32, threads: 1, ..Options::default() };
    let mut c = Simulation::new(&registry, &scene, &on_cpu).unwrap();
    let [mut g, mut many] = [(); 2].map(|()| Simulation::new(&registry, &scene, &on_gpu()).unwrap());
    let start = g.ledger();
    let mut given = [[0.0; 3]; 2];
    let mut drawn = |g: &mut Simulation, c: &mut Simulation, steps: usize| {
        for (sim, given) in [&mut *g, c].into_iter().zip(&mut given) {
            for _ in 0..steps {
                let dt = sim.step().unwrap_or_else(|e| panic!("{e}")).dt;
                (0..3).for_each(|d| given[d] += sim.wrenches()[0].force[d] * dt);
            }
        }
        let live = [&*g, c].map(|sim| sim.particles().levels.unwrap().live);
        assert_eq!(live[0], live[1], "live tiles at {} s", g.time());
    };
    for _ in 0..5 {
        drawn(&mut g, &mut c, 60);
    }
    take_at_once(&mut many, 300);
    assert!(left(&many) == left(&g), "steps taken at once are something else");
    let [on_gpu_now, on_cpu_now] = [&g, &c].map(|sim| furrow_depth(&sim.ground(), 0.3));
    println!("furrow {on_gpu_now:.4} m and {on_cpu_now:.4} m deep; {:?}\n{:?}", g.ledger().counts, c.ledger().counts);
    within("depth of the furrow beside the CPU's, in cells", (on_gpu_now - on_cpu_now).abs() / FURROW_CELL, 0.25);
    for (velocity, steps) in [([0.0, 0.0, 4.0], 80), ([16.0, 0.0, 0.0], 180)] {
        [&mut g, &mut c]
            .into_iter()
            .for_each(|sim| sim.act("ball", &Command::Twist { linear: velocity, angular: [0.0; 3] }).unwrap());
        drawn(&mut g, &mut c, steps);
    }
    assert!(furrow_depth(&g.particles(), 0.1).is_nan(), "the furrow's beginning is out of reach");
    let kept = furrow_depth(&g.ground(), 0.1);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    g.save(&file).unwrap();
    let mut resumed = Simulation::resume(&registry, &file, &on_gpu()).unwrap();
    assert!(resumed.particles() == g.particles(), "what is resumed is what was saved");
    [&mut g, &mut c, &mut resumed]
        .into_iter()
        .for_each(|sim| sim.act("ball", &Command::Twist { linear: [-16.0, 0.0, 0.0], angular: [0.0; 3] }).unwrap());
    drawn(&mut g, &mut c, 220);
    take(&mut resumed, 220);
    let found = furrow_depth(&g.particles(), 0.1);
    let (after, there) = (g.ledger(), c.ledger());
    println!("kept {kept:.4} m deep, found {found:.4} m; {:?}\n{:?}", after.counts, there.counts);
    within("furrow found on coming back: change of depth, in cells", (found - kept).abs() / FURROW_CELL, 0.25);
    assert_eq!(resumed.particles().levels, g.particles().levels);
    for what in ["tiles brought in from the terrain", "tiles brought back from the archive"] {
        assert!(after.counts[what] > 0 && after.counts[what] == there.counts[what], "{what}");
    }
    let lost = |l: &Ledger| l.mass + l.deleted_mass - l.seeded_mass;
    within("mass less what came in, change", (lost(&after) / lost(&start) - 1.0).abs(), 1e-6);
    for (name, ledger, given) in [("the GPU", &after, given[0]), ("the CPU", &there, given[1])] {
        let balance: Vec3 = std::array::from_fn(|d| {
            ledger.momentum[d] - start.momentum[d] - ledger.wall_impulse[d] - ledger.gravity_impulse[d] + given[d]
        });
        within(&format!("balance of momentum on {name}"), norm(balance) / norm(ledger.gravity_impulse), 1e-4);
    }
}

/// Snow and jelly at rest with an uneven surface, and an agent above that crosses it in leaps.
fn leaps() -> String {
    Head { gravity: [0.0; 3], ..Head::space(0.05) }.time("step = 1e-5\nover_bound = \"allow\"").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4"),
        material("snow", 400.0, "young_modulus = 1e4"),
        block("neo_hookean", [-1.0, -0.4, -0.2], [1.0, 0.4, 0.1], "around_tools = false"),
        block("snow", [-1.0, -0.4, 0.1], [0.4, 0.2, 0.3], "sampling = \"jitter\"\naround_tools = false"),
        "[levels]\ncount = 3\nhalf = 12\nagents = [\"eye\"]\n".to_owned(),
        tool("eye", [-1.0, 0.0, 0.65], "sphere = { radius = 0.05 }", "\"slip\"", &driven([1.0, 0.0, 0.0])),
    ])
}

/// For each level: particles; mass [kg], momentum [kg m/s], first moment [kg m], and second moment and history of all.
fn on_each_level(rows: &[Row]) -> Vec<(usize, [f64; 9])> {
    let mut levels = vec![(0, [0.0; 9]); 3];
    for r in rows {
        let (count, sums) = &mut levels[r.level as usize];
        *count += 1;
        let (square, past) = (r.x.iter().map(|x| x * x).sum::<f64>(), r.state.iter().sum::<f64>());
        let values = [1.0, r.v[0], r.v[1], r.v[2], r.x[0], r.x[1], r.x[2], square, past];
        sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += r.m * value);
    }
    levels
}

/// Rounds of split and merge in which only those particles leave the device that are concerned: of the same state they make the same as the
/// CPU, level by level; they keep mass, momentum and the centre of mass, and give each particle a number of its own. A copy of what they leave
/// behind is exact.
#[test]
fn rounds_on_the_device_leave_what_the_cpu_leaves() {
    let (mut g, mut again, mut c) = (gpu(&leaps()), gpu(&leaps()), on("cpu", Precision::F32, &leaps()));
    let mut noise = Noise::new(5);
    // Histories and velocities that differ, so that their means show.
    alter(&mut c, |row| {
        row.state.iter_mut().for_each(|q| *q += 1e-3 * noise.draw());
        row.v = [0.1 + 0.01 * noise.draw(), 0.01 * noise.draw(), 0.01 * noise.draw()];
    });
    let happened = |sim: &Simulation| {
        let counts = sim.ledger().counts;
        ["particles split", "particles merged", "particles that changed level"]
            .map(|what| counts.get(what).copied().unwrap_or(0))
    };
    let (mut rounds, mut most) = (0, [0.0f64; 3]);
    for leap in 0..60 {
        // Away over the end and back.
        let speed = if leap < 30 { 1e4 } else { -1e4 };
        let state = c.particles();
        [&mut g, &mut again].into_iter().for_each(|sim| sim.set_particles(state.clone()).unwrap());
        [&mut g, &mut again, &mut c]
            .into_iter()
            .for_each(|sim| sim.act("eye", &Command::Twist { linear: [speed, 0.0, 0.0], angular: [0.0; 3] }).unwrap());
        let (before, start) = (rows(&c), [happened(&g), happened(&c)]);
        [&mut g, &mut again, &mut c].into_iter().for_each(|sim| take(sim, 1));
        let (phase, there) = (c.particles().levels.unwrap(), g.particles());
        if phase.boxes == state.levels.unwrap().boxes {
            continue;
        }
        rounds += 1;
        assert_eq!(there.levels, Some(phase), "leap {leap}");
        assert!(again.particles() == there, "leap {leap}: two rounds differ");
        let did = [(&g, start[0]), (&c, start[1])].map(|(sim, start)| {
            let now = happened(sim);
            [0, 1, 2].map(|k| now[k] - start[k])
        });
        assert_eq!(did[0], did[1], "leap {leap}: particles split, merged, and moved");
        let (on_gpu, on_cpu) = (rows(&g), rows(&c));
        assert!(on_gpu.windows(2).all(|pair| pair[0].id < pair[1].id), "leap {leap}: two particles with one number");
        let (a, b) = (on_each_level(&on_gpu), on_each_level(&on_cpu));
        let total = |levels: &[(usize, [f64; 9])], k: usize| levels.iter().map(|(_, sums)| sums[k]).sum::<f64>();
        let start = on_each_level(&before);
        let mass = total(&start, 0);
        for (level, ((count, sums), (of_cpu, expected))) in a.iter().zip(&b).enumerate() {
            assert_eq!(count, of_cpu, "leap {leap}: particles on level {level}");
            let off = sums.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            most[0] = most[0].max(off / mass);
        }
        most[1] = most[1].max((total(&a, 0) - mass).abs() / mass);
        for k in 1..7 {
            // What moves in a step.
            let by_step = if k > 3 { 1e-5 * total(&start, k - 3) } else { 0.0 };
            most[2] = most[2].max((total(&a, k) - total(&start, k) - by_step).abs() / mass);
        }
        g.set_particles(there.clone()).unwrap();
        assert!(g.particles() == there, "leap {leap}: a copy differs");
    }
    println!("{rounds} rounds, {:?}", happened(&g));
    assert!(rounds > 20 && happened(&g).iter().all(|count| *count > 500), "the test must see something");
    within("sums on a level beside the CPU's, by mass", most[0], 1e-6);
    within("change of mass, relative", most[1], 1e-6);
    within("change of momentum and centre of mass [m/s, m]", most[2], 1e-6);
}

/// A round with nothing to do changes nothing: a block that flies and spins while levels follow an agent far above it, and while that stands
/// still. At rest not a bit of it changes.
#[test]
fn rounds_with_nothing_to_do_change_nothing() {
    let fly = |motion: &str, speed: f64| {
        let mut sim = gpu(&Head { gravity: [0.0; 3], ..Head::space(0.02) }.time("step = 1e-3").with(&[
            material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("hencky", [0.0, 0.0, -0.1], [0.1, 0.1, 0.0], motion),
            "[levels]\ncount = 2\nhalf = 8\nagents = [\"eye\"]\n".to_owned(),
            tool("eye", [0.0, 0.0, 0.85], "sphere = { radius = 0.01 }", "\"slip\"", &driven([speed, 0.0, 0.0])),
        ]));
        let start = rows(&sim);
        take(&mut sim, 40);
        let phase = sim.particles().levels.unwrap();
        assert!(phase.rounds == 0 && speed == 0.0 || phase.rounds >= 4, "{} rounds", phase.rounds);
        assert!(sim.ledger().counts.iter().all(|(what, count)| what.contains("now") || *count == 0));
        (start, rows(&sim))
    };
    let (start, end) = fly("", 8.0);
    assert!(start == end, "a block at rest has changed");
    let spin = "velocity = [1.0, 0.4, -0.2]\nangular_velocity = [0.0, 5.0, 9.0]";
    within("distance of particles, in cells", apart(&fly(spin, 0.0).1, &fly(spin, 8.0).1) / 0.02, 1e-5);
}

/// A run that is saved between rounds goes on as if it had not been: the same particles, to what finding their stress anew rounds off.
#[test]
fn a_run_on_levels_goes_on_after_it_was_saved() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    let go_on = |sim: &mut Simulation| {
        for step in 0..20 {
            sim.act(
                "eye",
                &Command::Twist { linear: [if step % 6 < 4 { 1e4 } else { -5e3 }, 0.0, 0.0], angular: [0.0; 3] },
            )
            .unwrap();
            take(sim, 1);
        }
    };
    let mut sim = gpu(&leaps());
    go_on(&mut sim);
    sim.save(&file).unwrap();
    let mut resumed = Simulation::resume(&barchan::registry(), &file, &on_gpu()).unwrap();
    let before = sim.particles().levels.unwrap().rounds;
    go_on(&mut sim);
    go_on(&mut resumed);
    let (a, b) = (sim.particles(), resumed.particles());
    assert_eq!(a.levels, b.levels);
    assert!(a.levels.unwrap().rounds >= before + 2);
    within("distance of particles, in cells", apart(&rows(&sim), &rows(&resumed)) / 0.05, 1e-6);
}
