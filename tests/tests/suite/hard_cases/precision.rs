//! Transfers, precision, data structures.

use super::{all_finite, momentum, norm, place, refusal, says, steps, until, within};
use barchan::{Error, Options, Precision, Simulation};
use barchan_tests::long_cases;
use barchan_tests::scenes::{alter, options, rows, run_to, scene, simulation};
use barchan_tests::sketch::{Head, bed, block, half, material, tool};

/// A jelly block that is thrown at a floor, with a heap of sand beside it, all moved by `shift` cells.
fn thrown(shift: [i32; 3], with_tool: bool) -> String {
    let h = 1.0 / 256.0;
    let at = |x: [f64; 3]| -> [f64; 3] { std::array::from_fn(|d| (f64::from(shift[d]) + x[d]) * h) };
    let mut parts = vec![
        material("neo_hookean", 1000.0, "young_modulus = 2e4"),
        material("sand", 1500.0, "young_modulus = 2e4"),
        block(
            "neo_hookean",
            at([4.0, 4.0, 2.0]),
            at([10.0, 10.0, 8.0]),
            "velocity = [0.3, 0.1, -1]\nangular_velocity = [3, 2, 1]",
        ),
        block("sand", at([12.0, 2.0, 0.0]), at([20.0, 10.0, 6.0]), ""),
    ];
    if with_tool {
        let contact = "{ coulomb = { friction = 0.3 } }";
        parts.push(tool(
            "rod",
            at([16.0, 6.0, 7.0]),
            &half([2.6 * h; 3]),
            contact,
            "{ velocity = { linear = [0.2, 0, -0.4] } }",
        ));
    }
    Head {
        min: at([-8.0, -8.0, 0.0]),
        max: at([40.0, 24.0, 24.0]),
        time: "step = 2e-4".to_owned(),
        ..Head::cells(h, [0; 3], "z_min = \"stick\"\nx_min = \"slip\"\nx_max = { separate = { friction = 0.3 } }")
    }
    .with(&parts)
}

/// The trajectory of each particle in its cells, without the shift.
fn trajectory(shift: [i32; 3], with_tool: bool, precision: Precision) -> Vec<[f64; 3]> {
    let mut s = simulation(&thrown(shift, with_tool), precision);
    steps(&mut s, 150);
    let state = s.particles();
    let mut all: Vec<(u64, [f64; 3])> = state
        .lists
        .iter()
        .flat_map(|l| {
            (0..l.len())
                .map(|i| (l.id[i], std::array::from_fn(|d| f64::from(l.cell[i][d] - shift[d]) + l.offset[i][d])))
        })
        .collect();
    all.sort_by_key(|(id, _)| *id);
    all.into_iter().map(|(_, x)| x).collect()
}

fn apart(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    a.iter().zip(b).flat_map(|(a, b)| (0..3).map(|d| (a[d] - b[d]).abs())).fold(0.0, f64::max)
}

/// B17. Symptom: 10 km from the origin in f32 motion stalls and jitters: one unit in the last place is a quarter of a cell.
/// Physics: nothing depends on where the origin is. Positions are a cell and an offset within it, so trajectories are equal bit
/// for bit; tools live in f64 metres and may round.
#[test]
fn ten_kilometres_away_everything_is_the_same() {
    // 10 km are 2 560 000 cells of 1/256 m; so far in every direction, also on the negative side.
    for precision in [Precision::F32, Precision::F64] {
        let home = trajectory([0; 3], false, precision);
        for shift in [[2_560_000, 2_560_000, 0], [-2_560_000, 1_280_000, 2_560_000]] {
            let far = trajectory(shift, false, precision);
            within(&format!("B17 {precision}, shifted by {shift:?} cells: distance [h]"), apart(&home, &far), 0.0);
        }
        let (home, far) =
            (trajectory([0; 3], true, precision), trajectory([2_560_000, -2_560_000, 0], true, precision));
        within(&format!("B17 {precision}, with a tool 14 km away: distance [h]"), apart(&home, &far), 1e-5);
    }
}

/// B18. Symptom: what moves slowly stands still: v dt is below half a unit of the position's last place. Physics: 0.1 mm/s for
/// 60 s is 6 mm. On a cell of 0.1 m that is 1.7 millionths of a cell in each step.
#[test]
fn slow_motion_does_not_stall() {
    for (precision, h) in [(Precision::F32, 0.1), (Precision::F32, 1.0 / 256.0), (Precision::F64, 0.1)] {
        let mut slow = simulation(
            &Head::space(h).time("step = 2e-3\nover_bound = \"allow\"").with(&[
                material("neo_hookean", 1000.0, "young_modulus = 1e2"),
                block("neo_hookean", [3.0 + 0.3 * h; 3], [3.0 + 1.3 * h; 3], "velocity = [1e-4, -1e-4, 1e-4]"),
            ]),
            precision,
        );
        let start = rows(&slow);
        let all = until(&mut slow, 60.0);
        let worst =
            start.iter().zip(&all).flat_map(|(a, b)| (0..3).map(|d| ((b.x[d] - a.x[d]).abs() / 6e-3 - 1.0).abs()));
        within(
            &format!("B18 {precision}, h {h:.4} m: 60 s at 0.1 mm/s, way off 6 mm"),
            worst.fold(0.0, f64::max),
            0.01,
        );
    }
}

/// B19. Symptom: a particle exactly on a face, a node or a corner gets weights that do not sum to 1, or two cells. Physics: the
/// weights are continuous there. In all 27 combinations, inside and in the corner of the world: a particle in free fall gains
/// exactly g dt, its momentum is that of the walls and gravity, and nothing is infinite.
#[test]
fn places_on_faces_nodes_and_corners_are_like_any_other() {
    let below_one = 1.0 - 1.0 / f64::from(1u32 << 31) / 2.0;
    for precision in [Precision::F32, Precision::F64] {
        for walls in [
            "",
            "x_min = \"slip\"\ny_min = \"slip\"\nz_min = \"slip\"",
            "x_min = \"stick\"\ny_min = \"stick\"\nz_min = \"stick\"",
        ] {
            // Cell 8 is inside, on the edge of a block; cell 0 is in the corner of the world.
            for cell in [8, 0] {
                let mut worst = 0f64;
                for combination in 0..27 {
                    let offset =
                        [0, 3, 9].map(|place: u32| [0.0, 0.5, below_one][(combination / place.max(1) % 3) as usize]);
                    let head =
                        Head { gravity: [-1.0, -2.0, -3.0], ..Head::cells(0.1, [16; 3], walls) }.time("step = 1e-3");
                    let parts = [
                        material("neo_hookean", 1000.0, "young_modulus = 1e5"),
                        block("neo_hookean", [0.42; 3], [0.47; 3], ""),
                    ];
                    let mut s = simulation(&head.with(&parts), precision);
                    let mut state = s.particles();
                    state.lists[0].cell[0] = [cell; 3];
                    state.lists[0].offset[0] = offset;
                    state.sort = None;
                    s.set_particles(state).unwrap();
                    s.step().unwrap();
                    let all = rows(&s);
                    assert!(all_finite(&all), "{precision} {walls} {cell} {offset:?}");
                    let ledger = s.ledger();
                    for d in 0..3 {
                        let expected = [-1e-3, -2e-3, -3e-3][d];
                        // What gravity and walls gave is what the particle has, unless a stick wall holds the node it hangs on.
                        if cell == 8 || walls.is_empty() {
                            worst = worst.max((all[0].v[d] / expected - 1.0).abs());
                        } else {
                            assert!(all[0].v[d].abs() <= 1.001 * expected.abs(), "{:?}", all[0].v);
                        }
                        assert!(ledger.wall_impulse[d].is_finite() && ledger.wall_impulse[d] >= -1e-12);
                    }
                }
                let tolerance = if precision == Precision::F32 { 1e-6 } else { 1e-13 };
                within(
                    &format!("B19 {precision}, cell {cell}: velocity gained off g dt, of 27 places"),
                    worst,
                    tolerance,
                );
            }
        }
    }
}

/// Sand that flies out of an open side.
fn leaving(policy: &str) -> String {
    let head =
        Head { world: policy_of(policy), ..Head::cells(0.1, [12, 8, 8], "z_min = \"slip\"") }.time("step = 1e-3");
    head.with(&[
        material("sand", 1500.0, "young_modulus = 1e5"),
        block("sand", [0.4, 0.2, 0.0], [0.8, 0.6, 0.4], "velocity = [2, 0.3, 0]\nsampling = \"jitter\""),
    ])
}

fn policy_of(policy: &str) -> &'static str {
    match policy {
        "clamp" => "leaving = \"clamp\"",
        "delete" => "leaving = \"delete\"",
        _ => "",
    }
}

/// B20. Symptom: what leaves the world vanishes, or has its speed clipped without a word. Physics: mass and momentum have to go
/// somewhere: the run stops and names the particle, or the particle is put back with its impulse booked, or deleted with its
/// mass booked.
#[test]
fn leaving_the_world_is_booked() {
    let mut refused = simulation(&leaving("error"), Precision::F64);
    let error = (0..1000).find_map(|_| refused.step().err()).expect("particles leave");
    says(
        &error,
        &["left the world at (1.2", "widen world.min/max, add walls, or set world.leaving to \"clamp\" or \"delete\""],
    );
    let Error::LeftWorld { particle, step, .. } = error else { panic!("{error}") };
    let x = rows(&refused)[particle as usize].x;
    assert!(x[0] >= 1.2 && step == refused.step_count(), "{x:?}");

    for policy in ["clamp", "delete"] {
        let mut s = simulation(&leaving(policy), Precision::F64);
        let before = s.ledger();
        steps(&mut s, 500);
        let after = s.ledger();
        let total = (after.mass + after.deleted_mass) / before.mass - 1.0;
        within(&format!("B20 {policy}: mass here and booked off that at the start"), total.abs(), 1e-12);
        let key = if policy == "clamp" { "particles put back into the world" } else { "particles deleted on leaving" };
        println!("B20 {policy}: {key}: {}", after.counts[key]);
        if policy == "delete" {
            let gone = after.counts[key];
            assert_eq!((after.particles, gone > 100), (before.particles - gone, true));
            within(
                "B20 delete: booked mass off that of the particles",
                (after.deleted_mass / (gone as f64 * 1500.0 * 1.25e-4) - 1.0).abs(),
                1e-12,
            );
        } else {
            let scale = norm(before.momentum);
            for d in 0..3 {
                let closed = after.momentum[d] - before.momentum[d] - after.gravity_impulse[d] - after.wall_impulse[d];
                within("B20 clamp: momentum not explained by walls and gravity", closed.abs() / scale, 1e-12);
            }
            // Particles are put back when they are sorted, which is before any has moved by more than a cell and a half.
            assert!(rows(&s).iter().all(|r| r.x[0] < 1.2 + 0.15));
        }
    }
}

/// B21. Symptom: a node that a particle just touches has a mass of 1e-12 particles; p/m blows up, or a cut-off in kg takes its
/// momentum and changes the physics with the unit of mass. Physics: velocities are ratios and carry no unit of mass; momentum
/// is conserved whatever the weights.
#[test]
fn tiny_node_masses_neither_explode_nor_swallow_momentum() {
    for (precision, tolerance) in [(Precision::F32, 2e-6), (Precision::F64, 1e-13)] {
        for offset in [1e-3, 1e-5, 1e-7, 2.4e-10, 0.0, 0.5, 1.0 - 1e-7, 1.0 - 2.4e-10] {
            let mut lone = simulation(
                &Head::space(0.1).time("step = 1e-3").with(&[
                    material("neo_hookean", 1000.0, "young_modulus = 1e5"),
                    block("neo_hookean", [0.0; 3], [0.1; 3], "velocity = [1, 2, 3]"),
                ]),
                precision,
            );
            place(&mut lone, |r| {
                let first = r.x;
                (0..3).for_each(|d| r.x[d] = (first[d] / 0.05).floor() * 0.1 + 0.1 * offset);
            });
            alter(&mut lone, |r| r.strain[..3].fill(0.9));
            let before = rows(&lone);
            let (p, fastest) = (momentum(&before), |s: &Simulation| rows(s).iter().fold(0f64, |f, r| f.max(norm(r.v))));
            steps(&mut lone, 5);
            let after = rows(&lone);
            let lost = norm(std::array::from_fn::<_, 3, _>(|d| momentum(&after)[d] - p[d])) / norm(p);
            // The speed of sound times the strain bounds what stress can do.
            println!(
                "B21 {precision}, offset {offset:.1e}: momentum lost {lost:.1e} ({tolerance:.0e}), fastest {:.2} m/s",
                fastest(&lone)
            );
            assert!(lost < tolerance && fastest(&lone) < 10.0 && all_finite(&after));
        }
    }
    // The same with masses and moduli 2^-40 of those: not a bit of the motion may change.
    let light = |factor: f64| {
        let (head, _) = bed(0.1, [8, 8], 3, 8, "");
        let e = format!("young_modulus = {:e}", 2f64.powi(17) * factor);
        let mut s = simulation(
            &Head { world: "", ..head }.time("step = 1e-3").with(&[
                material("neo_hookean", 1024.0 * factor, &e),
                block(
                    "neo_hookean",
                    [0.1, 0.2, 0.05],
                    [0.5, 0.6, 0.45],
                    "velocity = [1, 0, -2]\nangular_velocity = [1, 5, 2]",
                ),
            ]),
            Precision::F32,
        );
        steps(&mut s, 200);
        rows(&s).into_iter().map(|r| (r.x, r.v, r.strain)).collect::<Vec<_>>()
    };
    let (heavy, light) = (light(1.0), light(2f64.powi(-40)));
    let differ = heavy.iter().zip(&light).filter(|(a, b)| a != b).count();
    within("B21: particles that move differently if all masses are 1e-12 of theirs", differ as f64, 0.0);
}

/// B22, on the CPU. Symptom: impulses summed in fixed point truncate to zero at h = 1/256 m, and a light box falls through
/// sand. Physics: at rest the sand pushes with m g.
#[test]
fn light_box_on_fine_sand_is_carried() {
    let (h, side) = (1.0 / 256.0, 0.03);
    let (head, mut parts) = bed(h, [16, 16], 6, 16, "young_modulus = 1e5, friction_angle_deg = 35");
    let z = 6.0 * h + 0.5 * side;
    parts.push(tool(
        "box",
        [8.0 * h, 8.0 * h, z],
        &half([0.5 * side; 3]),
        "{ coulomb = { friction = 0.5 } }",
        "{ free = { mass = 0.1 } }",
    ));
    let mut s = simulation(&head.with(&parts), Precision::F32);
    run_to(&mut s, 0.3);
    let (mut sum, mut time) = (0.0, 0.0);
    while s.time() < 0.5 {
        let dt = s.step().unwrap().dt;
        sum += s.wrenches()[0].force[2] * dt;
        time += dt;
    }
    within("B22: mean push over m g of 0.981 N, off by", (sum / time / 0.981 - 1.0).abs(), 0.02);
    within("B22: sinkage [h]", (z - s.bodies()[0].position[2]) / h, 1.0);
}

/// B24, on the CPU: f32 against f64. Symptom: the cheaper number format gives other physics. Physics: 200 steps of an elastic
/// body amplify rounding only little.
#[test]
fn f32_follows_f64() {
    let cube = |precision| {
        let mut s = simulation(
            &Head { gravity: [0.0, 0.0, -9.81], ..Head::cells(0.05, [16, 16, 16], "z_min = \"slip\"") }
                .time("step = 1e-3")
                .with(&[
                    material("neo_hookean", 1000.0, "young_modulus = 1e5"),
                    block(
                        "neo_hookean",
                        [0.2, 0.2, 0.02],
                        [0.5, 0.5, 0.32],
                        "velocity = [0.5, 0, -2]\nangular_velocity = [2, 0, 1]\nsampling = \"jitter\"",
                    ),
                ]),
            precision,
        );
        steps(&mut s, 200);
        rows(&s).into_iter().map(|r| r.x.map(|x| x / 0.05)).collect::<Vec<_>>()
    };
    within("B24: f32 from f64 after 200 elastic steps [h]", apart(&cube(Precision::F32), &cube(Precision::F64)), 1e-3);
}

/// B25. Symptom: more particles or blocks than there is room for, or coordinates that collide in a hash, drop mass without a
/// word. Physics: none is ever dropped. Memory is asked for before it is taken, cells beyond the reach of keys are refused, and
/// a scene across the origin is that beside it.
#[test]
fn capacity_is_an_error_and_negative_cells_are_cells() {
    let (head, parts) = bed(0.05, [8, 8], 4, 8, "young_modulus = 1e5");
    let text = head.with(&parts);
    let options = Options { max_bytes: Some(100_000), ..options(Precision::F32) };
    let error = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap_err();
    says(&error, &["memory for particles [bytes]", "is above the cap 100000", "raise world.cell or spacing"]);
    assert!(matches!(error, Error::Capacity { .. }));

    // Blocks are told apart up to 2^20 of them, 2^22 cells, on either side of the origin.
    let reach = 4.0 * f64::from(1 << 20);
    let far = |cells: f64| {
        let head = Head { min: [cells - 20.0, 0.0, 0.0], max: [cells + 20.0, 4.0, 4.0], ..Head::space(1.0) }
            .time("step = 1e-3");
        head.with(&[
            material("sand", 1500.0, "young_modulus = 1e5"),
            block("sand", [cells - 2.0, 0.0, 0.0], [cells + 2.0, 2.0, 2.0], ""),
        ])
    };
    for side in [-1.0, 1.0] {
        let mut near = simulation(&far(side * (reach - 16.0)), Precision::F32);
        steps(&mut near, 5);
        within(
            &format!("B25 at {:.0} cells: mass lost", side * reach),
            (near.ledger().mass / (16.0 * 1500.0) - 1.0).abs(),
            1e-12,
        );
        // Assembling or the first step refuses, and says why.
        let beyond =
            Simulation::new(&barchan::registry(), &scene(&far(side * (reach + 8.0))), &super::options(Precision::F32));
        let error = beyond.and_then(|mut s| s.step()).expect_err("beyond the reach of keys");
        says(&error, &["distance from the origin in cells", "coarser world.cell or move the scene"]);
    }

    // Blocks on both sides of the origin, whose coordinates change sign.
    let home = trajectory([0; 3], false, Precision::F32);
    for shift in [[-8, -8, -4], [-16, -4, 0], [-12, 4, -16]] {
        within(
            &format!("B25, shifted by {shift:?} cells: distance [h]"),
            apart(&home, &trajectory(shift, false, Precision::F32)),
            0.0,
        );
    }
}

/// B26. Symptom: the empty case, which nobody tried, divides by zero. Physics: nothing happens.
#[test]
fn empty_scenes_run_and_empty_bodies_are_refused() {
    let head = Head::space(0.1);
    for parts in [
        vec![],
        vec![material("sand", 1500.0, "")],
        vec![tool("rod", [0.0; 3], &half([0.1; 3]), "\"stick\"", "{ velocity = { linear = [0.1, 0, 0] } }")],
        vec![tool(
            "ball",
            [0.0; 3],
            "sphere = { radius = 0.1 }",
            "\"stick\"",
            "{ free = { mass = 1, linear = [0.1, 0, 0] } }",
        )],
    ] {
        let mut empty = simulation(&head.with(&parts), Precision::F32);
        run_to(&mut empty, 0.1);
        let ledger = empty.ledger();
        assert_eq!((ledger.particles, ledger.mass), (0, 0.0));
        for body in empty.bodies() {
            within(&format!("B26: {} moves by 0.1 m/s, off [m]", body.name), (body.position[0] - 0.01).abs(), 1e-12);
        }
        assert!(empty.wrenches().iter().all(|w| w.force == [0.0; 3] && w.torque == [0.0; 3]));
    }

    // A tool with no ground near it.
    let mut lone = simulation(
        &Head { gravity: [0.0, 0.0, -9.81], ..Head::space(0.1) }.time("step = 1e-3").with(&[
            material("sand", 1500.0, "young_modulus = 1e5"),
            block("sand", [0.02; 3], [0.07; 3], ""),
            tool("rod", [2.0; 3], &half([0.2; 3]), "\"stick\"", "{ velocity = { linear = [0.1, 0, 0] } }"),
        ]),
        Precision::F64,
    );
    steps(&mut lone, 100);
    let all = rows(&lone);
    assert_eq!(all.len(), 1);
    within("B26: one particle alone falls by g dt n, off [m/s]", (all[0].v[2] + 0.981).abs(), 1e-12);
    assert_eq!(lone.wrenches()[0].force, [0.0; 3]);

    let with_body = |min: [f64; 3], max: [f64; 3], more: &str| {
        head.with(&[material("sand", 1500.0, ""), block("sand", min, max, more)])
    };
    says(
        &refusal(&with_body([0.0; 3], [0.3, 0.3, 0.0], "")),
        &["case.toml:", "body[0].shape.box.max", "z goes from 0 to 0: the box has no volume"],
    );
    says(
        &refusal(&with_body([0.0; 3], [0.3, 0.3, 0.01], "")),
        &["has no particles", "below half the spacing", "lower spacing or world.cell"],
    );
    let inside = format!(
        "{}{}",
        with_body([0.0; 3], [0.3; 3], ""),
        tool("rod", [0.1; 3], &half([1.0; 3]), "\"stick\"", "\"fixed\"")
    );
    says(&refusal(&inside), &["has no particles", "all 216 are inside tools", "around_tools = false"]);
    let empty_world = Head { max: [-4.0, 4.0, 4.0], ..Head::space(0.1) }.with(&[]);
    says(&refusal(&empty_world), &["world.max", "must be above world.min"]);
}

/// B27. See [`long_cases::resets`].
#[test]
fn reset_and_step_gives_the_same_episode() {
    long_cases::resets(60, false).check("B27");
}
