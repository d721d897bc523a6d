//! Hard cases whose point is to last. The suite runs them short, `examples/long_cases.rs` whole; both run the same code.

use crate::report::Outcome;
use crate::scenes::{alter, lean, options, rows, run_to, scene, simulation};
use crate::sketch::{Head, bed, block, half, material, tool};
use barchan::accuracy::{Grain, HeightMap};
use barchan::scene::{Motion, Shape};
use barchan::{Ledger, Options, ParticleState, Precision, Scene, Simulation, Vec3};
use std::f64::consts::TAU;

/// Laws with parameters, all softer than 1 MPa.
pub const LAWS: [(&str, &str); 7] = [
    ("neo_hookean", "young_modulus = 1e5"),
    ("fixed_corotated", "young_modulus = 1e5"),
    ("hencky", "young_modulus = 1e5"),
    ("sand", "young_modulus = 1e5"),
    ("snow", "young_modulus = 1e5"),
    ("von_mises", "young_modulus = 1e5"),
    ("liquid", "bulk_modulus = 1e5"),
];

/// B7: matter at rest without gravity, of every law, stays at rest bit for bit.
///
/// Any scheme whose stress at rest, weights or position updates are only nearly zero creeps within 1e5 steps. The figure is
/// the number of particles that differ in any bit.
pub fn rest(steps: u64) -> Outcome {
    let mut outcome = Outcome { steps, ..Outcome::default() };
    for precision in [Precision::F32, Precision::F64] {
        let mut parts = Vec::new();
        for (i, (law, parameters)) in LAWS.into_iter().enumerate() {
            let x = 0.4 * i as f64 - 1.2;
            parts.push(material(law, 1000.0, parameters));
            parts.push(block(law, [x, 0.0, 0.0], [x + 0.2, 0.2, 0.2], "sampling = \"jitter\""));
        }
        let mut at_rest = simulation(&Head::space(0.1).with(&parts), precision);
        let start = rows(&at_rest);
        for _ in 0..steps {
            at_rest.step().unwrap_or_else(|e| panic!("{e}"));
        }
        let moved = start.iter().zip(rows(&at_rest)).filter(|(a, b)| **a != *b).count();
        outcome.add(format!("{} particles of 7 laws at rest, {precision}: changed", start.len()), moved as f64, 0.0);
    }
    outcome
}

/// A rigid box at rest on sand.
pub fn box_on_sand(precision: Precision) -> Simulation {
    let (h, depth, side) = (0.02, 6, 0.08);
    let (mut head, mut parts) = bed(h, [12, 12], depth, 12, "young_modulus = 2e5, friction_angle_deg = 35");
    head.time.push_str("\nover_bound = \"substep\"");
    let z = h * f64::from(depth) + 0.5 * side;
    parts.push(tool(
        "box",
        [0.12, 0.12, z],
        &half([0.5 * side; 3]),
        "{ coulomb = { friction = 0.5 } }",
        &format!("{{ free = {{ mass = {} }} }}", 800.0 * side * side * side),
    ));
    simulation(&head.with(&parts), precision)
}

/// B44: a rigid box on sand keeps still: it neither sinks on, nor drifts, nor heats the sand.
///
/// Contact that jitters, or a yield surface touched anew at every step, lets a box sink for ever; noise that contact feeds
/// into the ground shows as kinetic energy that does not fall. Measured from the first second on.
pub fn box_at_rest(seconds: f64) -> Outcome {
    let h = 0.02;
    let mut outcome = Outcome::default();
    let mut rests = box_on_sand(Precision::F32);
    run_to(&mut rests, 1.0);
    let start = rests.bodies()[0].clone();
    let (mut early, mut late, mut push, mut count) = (0f64, 0f64, 0f64, 0.0);
    while rests.time() < seconds {
        let frame = (rests.time() + 0.02).min(seconds);
        run_to(&mut rests, frame);
        let ledger = rests.ledger();
        let energy = ledger.kinetic + ledger.body_kinetic;
        if rests.time() < 1.0 + 0.5 * (seconds - 1.0) {
            early = early.max(energy);
        } else {
            late = late.max(energy);
        }
        push += rests.wrenches()[0].force[2];
        count += 1.0;
    }
    let end = rests.bodies()[0].clone();
    let time = seconds - 1.0;
    let moved: [f64; 3] = std::array::from_fn(|d| (end.position[d] - start.position[d]) / h);
    outcome.steps = rests.step_count();
    outcome.add("sinkage [h/s]", -moved[2] / time, 0.02);
    outcome.add("drift sideways [h/s]", moved[0].hypot(moved[1]) / time, 0.002);
    // As a speed of all mass together.
    let mass = rests.ledger().mass;
    outcome.add("noise of the ground [m/s]", (2.0 * late / mass).sqrt(), 1e-3);
    outcome.add("kinetic energy, second half over first", late / early, 1.05);
    outcome.add("mean push over weight, off by", (push / count / (start.mass * 9.81) - 1.0).abs(), 0.01);
    outcome
}

/// Change of a column's height over `cycles` of shaking, as a share, and the steps taken.
fn shaken_column(cycles: u32, correction: u8) -> (f64, u64) {
    let (h, depth, frequency, pull) = (0.05, 8, 8.0, 6.0);
    let parameters = format!("young_modulus = 5e5, friction_angle_deg = 20, volume_correction = {correction}");
    let (head, parts) = bed(h, [4, 4], depth, 8, &parameters);
    let mut column = simulation(&head.with(&parts), Precision::F32);
    run_to(&mut column, 0.5);
    let height = |s: &Simulation| {
        let all = rows(s);
        2.0 * all.iter().map(|r| r.x[2]).sum::<f64>() / all.len() as f64
    };
    let start = height(&column);
    let (from, end) = (column.time(), f64::from(cycles) / frequency);
    while column.time() < from + end {
        // Seen from the base, a shaken column feels a pull that swings.
        let kick = pull * (TAU * frequency * (column.time() - from)).sin() * column.plan().dt;
        alter(&mut column, |r| r.v[0] += kick);
        column.step().unwrap_or_else(|e| panic!("{e}"));
    }
    let stop = column.time() + 0.5;
    run_to(&mut column, stop);
    (height(&column) / start - 1.0, column.step_count())
}

/// B11: a sand column that is shaken keeps its height.
///
/// Each cycle opens and closes some of the sand. Without the volume correction of Tampubolon et al. 2017 every closed cycle
/// leaves extra pressure, and the column grows. It is shaken with 6 m/s², beyond the 4.4 m/s² that its friction can follow.
pub fn cyclic_shear(cycles: u32) -> Outcome {
    let (with, steps) = shaken_column(cycles, 1);
    let (without, _) = shaken_column(cycles, 0);
    println!(
        "B11: {cycles} cycles change the height by {:+.4} %, without correction {:+.4} %",
        100.0 * with,
        100.0 * without
    );
    let mut outcome = Outcome { steps, ..Outcome::default() };
    outcome.add(format!("{cycles} cycles of shear: change of height (uncorrected {without:+.2e})"), with.abs(), 0.01);
    outcome
}

/// Resident bytes of this process, where the system tells.
fn resident() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/statm").ok()?;
    Some(4096.0 * status.split_whitespace().nth(1)?.parse::<f64>().ok()?)
}

/// A sand bed with a driven tool and a free body, for episodes.
pub fn episode_scene() -> String {
    let (head, mut parts) = bed(0.05, [8, 8], 3, 8, "young_modulus = 1e5, friction_angle_deg = 35");
    let contact = "{ coulomb = { friction = 0.4 } }";
    let rod = "capsule = { radius = 0.06, half_height = 0.1 }";
    parts.push(tool("rod", [0.12, 0.2, 0.2], rod, contact, "{ velocity = { linear = [0.6, 0.1, 0] } }"));
    let sphere = "sphere = { radius = 0.06 }";
    parts.push(tool("ball", [0.3, 0.25, 0.23], sphere, contact, "{ free = { mass = 1.5, linear = [0.1, 0, -1] } }"));
    head.with(&parts)
}

/// B27: reset and step, many times over: the last episode is the first one bit for bit, and memory does not grow.
///
/// Anything that outlives a reset (a sort's phase, a stale bound, a tool's wrench, a hash map's order) makes episodes differ;
/// anything that is not given back makes them end. Half of the resets hand particles back, half assemble the scene anew.
pub fn resets(cycles: u32, watch_memory: bool) -> Outcome {
    let mut outcome = Outcome::default();
    let registry = barchan::registry();
    let made = scene(&episode_scene());
    let play = |s: &mut Simulation, steps: u32| {
        for _ in 0..steps {
            s.step().unwrap_or_else(|e| panic!("{e}"));
        }
    };
    let new = || Simulation::new(&registry, &made, &options(Precision::F32)).unwrap_or_else(|e| panic!("{e}"));
    let mut first = new();
    play(&mut first, 30);
    let (end, bodies) = (first.particles(), first.bodies());

    // Without tools, since those have no reset of their own.
    let (head, parts) = bed(0.05, [8, 8], 3, 8, "young_modulus = 1e5");
    let mut reused = simulation(&head.with(&parts), Precision::F32);
    alter(&mut reused, |r| r.v = [0.3, 0.1, 0.5]);
    let mut start = reused.particles();
    start.sort = None;
    let again = |s: &mut Simulation| {
        s.set_particles(start.clone()).unwrap_or_else(|e| panic!("{e}"));
        play(s, 30);
        s.particles()
    };
    let settled = again(&mut reused);
    let (mut differ, mut before) = (0, None);
    for cycle in 0..cycles {
        if cycle % 2 == 0 {
            let mut s = new();
            play(&mut s, 30);
            differ += u32::from(s.particles() != end || s.bodies() != bodies);
        } else {
            differ += u32::from(again(&mut reused) != settled);
        }
        // What an allocator keeps for later is taken by then.
        if cycle == cycles / 10 {
            before = resident();
        }
    }
    outcome.steps = 30 * u64::from(cycles);
    outcome.add(format!("{cycles} resets: episodes that differ"), f64::from(differ), 0.0);
    if let (true, Some(before), Some(after)) = (watch_memory, before, resident()) {
        outcome.add("growth of resident memory [MiB]", (after - before) / f64::from(1 << 20), 4.0);
    }
    outcome
}

/// Cell width of the unbounded beds [m].
pub const FURROW_CELL: f64 = 0.04;
/// Depth of the sand in them [m].
pub const FURROW_DEPTH: f64 = 0.24;
/// Speed at which the ball is drawn through them [m/s].
pub const FURROW_SPEED: f64 = 4.0;

/// A ball half sunk in a bed of settled sand, `length` and `width` metres long and wide, of which two levels about the ball are live. It is
/// drawn along x, from 1.28 m behind the bed's end.
pub fn furrow_scene(length: f64, width: f64) -> String {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let (min, max) = ([-1.28, -0.5 * width, 0.0], [length - 1.28, 0.5 * width, 1.6]);
    let head = Head { min, max, world: "leaving = \"delete\"", ..Head::cells(FURROW_CELL, [0; 3], walls) };
    head.time("safety = 0.5").with(&[
        material("sand", 1600.0, "young_modulus = 2e5, friction_angle_deg = 40.0"),
        block("sand", min, [max[0], max[1], FURROW_DEPTH], "settled = true"),
        "[levels]\ncount = 2\nhalf = 8\nreach = 4\n".to_owned(),
        tool(
            "ball",
            [0.0, 0.0, FURROW_DEPTH],
            "sphere = { radius = 0.12 }",
            "{ coulomb = { friction = 0.3 } }",
            &format!("{{ velocity = {{ linear = [{FURROW_SPEED}, 0.0, 0.0] }} }}"),
        ),
    ])
}

/// Mean depth of the ground's surface below where it was, within 6 cm of the ball's track and 0.24 m of `x` [m]. Columns are a
/// cell wide.
pub fn furrow_depth(ground: &ParticleState, x: f64) -> f64 {
    let mut tops = [[f64::NEG_INFINITY; 3]; 12];
    for list in &ground.lists {
        for i in 0..list.len() {
            let at = list.position(i);
            // The rest of a long furrow is far off.
            if (at[0] - x).abs() > 1.0 {
                continue;
            }
            let half = 0.5 * list.volume0[i].cbrt();
            for (a, column) in tops.iter_mut().enumerate() {
                for (b, top) in column.iter_mut().enumerate() {
                    let centre = [x + FURROW_CELL * (a as f64 - 5.5), FURROW_CELL * (b as f64 - 1.0)];
                    if (0..2).all(|d| (at[d] - centre[d]).abs() < half.max(0.5 * FURROW_CELL)) {
                        *top = top.max(at[2] + half);
                    }
                }
            }
        }
    }
    let depths = tops.iter().flatten().filter(|top| top.is_finite()).map(|top| FURROW_DEPTH - top);
    depths.sum::<f64>() / tops.iter().flatten().filter(|top| top.is_finite()).count() as f64
}

/// For long ways, which would take an hour on one thread. The bits are the same on any number of them.
fn on_all_threads(scene: &Scene) -> Simulation {
    let options = Options { threads: 0, ..options(Precision::F32) };
    Simulation::new(&barchan::registry(), scene, &options).unwrap_or_else(|e| panic!("{e}"))
}

/// A tool drags a furrow so many metres long through ground of which only what is around the tool is live.
///
/// Symptom: the furrow is gone where the tool has been, or memory grows with the way it has come. Physics: what was changed stays as
/// it was left; what is kept is what was changed, so much a metre; mass is what was there and what has come within reach.
pub fn furrow(metres: f64) -> Outcome {
    let mut outcome = Outcome::default();
    let mut s = on_all_threads(&scene(&furrow_scene(metres + 3.84, 2.56)));
    let start = s.ledger();
    let to = |s: &mut Simulation, x: f64| run_to(s, x / FURROW_SPEED);
    // The ball has just left the first metre.
    to(&mut s, 1.6);
    let fresh = furrow_depth(&s.ground(), 1.0);
    to(&mut s, 0.5 * metres);
    let (half_count, half_bytes) = (s.particle_count(), archived_bytes(&s));
    to(&mut s, metres);
    let (end, bytes) = (s.ledger(), archived_bytes(&s));
    let ground = s.ground();
    let along: Vec<f64> = (1..metres as u32).map(|x| furrow_depth(&ground, f64::from(x))).collect();
    let shallowest = along.iter().copied().fold(f64::INFINITY, f64::min);
    let kept = |ledger: &Ledger| ledger.counts.get("tiles in the archive now").copied().unwrap_or(0) as f64;
    println!(
        "furrow of {metres} m: {shallowest:.4} m deep at least, {:.4} m in its first metre; {} live particles; {} tiles archived of {:.2} MB; {:?}",
        along[0],
        s.particle_count(),
        kept(&end),
        1e-6 * bytes,
        end.counts
    );
    outcome.steps = s.step_count();
    outcome.add(
        "change of the first metre's depth since the ball left [cells]",
        (along[0] - fresh).abs() / FURROW_CELL,
        0.25,
    );
    outcome.add("shallowest metre of the furrow [cells], short of one by", 1.0 - shallowest / FURROW_CELL, 0.0);
    outcome.add("live particles at the end over half way", s.particle_count() as f64 / half_count as f64, 1.2);
    outcome.add("archived tiles a tile of way", kept(&end) * 0.32 / metres, 5.0);
    let later = (bytes - half_bytes) / (0.5 * metres);
    outcome.add("kB archived a metre, second half", 1e-3 * later, 150.0);
    let mass = end.mass + end.deleted_mass - end.seeded_mass;
    outcome.add("mass live and archived less what came in, change", (mass / start.mass - 1.0).abs(), 1e-6);
    outcome
}

fn archived_bytes(s: &Simulation) -> f64 {
    s.ledger().counts.get("bytes in the archive now").map_or(f64::NAN, |bytes| *bytes as f64)
}

/// A quadruped trots so many metres over dunes of which only what is around its feet is live.
///
/// Symptom: its footprints are gone behind it, or what is kept of them grows to gigabytes. Physics: sand at rest keeps its shape, and nothing but what feet
/// have changed needs to be kept.
pub fn dunes(metres: f64) -> Outcome {
    let mut outcome = Outcome::default();
    let wide = [
        "world.cell=0.03125",
        "world.max=[150.0, 50.0, 1.5]",
        "body[0].shape.terrain.max=[150.0, 50.0]",
        "time.end=1000.0",
        // As soft as robots learn on: steps are twice as long.
        "material[0].parameters.young_modulus=2e5",
    ];
    let mut s = on_all_threads(&barchan::tasks::scene("quadruped-dunes", &wide).expect("quadruped-dunes is a scene"));
    let start = s.ledger();
    let base = |s: &Simulation| s.robots().remove(0);
    let (mut way, mut at, mut tilt) = (0.0, base(&s).position, 0f64);
    let (mut track, mut fresh) = (Vec::new(), None);
    while way < metres && s.time() < 8.0 * metres {
        let until = s.time() + 0.5;
        run_to(&mut s, until);
        let dog = base(&s);
        way += (dog.position[0] - at[0]).hypot(dog.position[1] - at[1]);
        at = dog.position;
        track.push([at[0], at[1]]);
        tilt = tilt.max(lean(&dog));
        if fresh.is_none() && way > 6.0 {
            fresh = Some(footprints(&s, &track[4..16]));
        }
    }
    let (fresh, kept) = (fresh.unwrap_or(f64::NAN), footprints(&s, &track[4..16]));
    let ledger = s.ledger();
    println!(
        "{way:.1} m in {:.0} s, tilt at most {tilt:.1} degrees; footprints {:.1} mm deep when left, {:.1} mm at the end; {:.2} MB; {:?}",
        s.time(),
        1e3 * fresh,
        1e3 * kept,
        1e-6 * archived_bytes(&s),
        ledger.counts
    );
    outcome.steps = s.step_count();
    outcome.add("metres not walked", metres - way, 0.0);
    outcome.add("greatest tilt [degrees]", tilt, 30.0);
    outcome.add("depth of the first footprints, short of 10 mm by [mm]", 10.0 - 1e3 * kept, 0.0);
    outcome.add("change of their depth since they were left [mm]", 1e3 * (kept - fresh).abs(), 1.0);
    outcome.add("kB archived a metre", 1e-3 * archived_bytes(&s) / way, 150.0);
    let mass = ledger.mass + ledger.deleted_mass - ledger.seeded_mass;
    outcome.add("mass live and archived less what came in, change", (mass / start.mass - 1.0).abs(), 1e-6);
    outcome
}

/// How deep the lowest tenth of the ground lies below its mean within a stride of a track, dunes taken off [m].
fn footprints(s: &Simulation, track: &[[f64; 2]]) -> f64 {
    let cell = s.plan().cell_widths[0];
    let near = |x: &Vec3| track.iter().any(|at| (x[0] - at[0]).hypot(x[1] - at[1]) < 0.25);
    let grains: Vec<Grain> = s.spots().iter().filter(|spot| near(&spot.position)).map(Grain::of).collect();
    let mut world = s.plan().scene.world.clone();
    for d in 0..2 {
        let ends = track.iter().fold([f64::MAX, f64::MIN], |[min, max], at| [min.min(at[d]), max.max(at[d])]);
        (world.min[d], world.max[d]) = (ends[0] - 0.25, ends[1] + 0.25);
    }
    let map = HeightMap::new(&grains, &world, cell);
    let heights = map.heights().iter().enumerate().map(|(i, top)| (map.at(i), *top));
    let tops: Vec<([f64; 2], f64)> = heights.filter(|(_, top)| *top > world.min[2] + cell).collect();
    let mut depths: Vec<f64> = tops
        .iter()
        .map(|(at, top)| {
            let around = tops.iter().filter(|(other, _)| (other[0] - at[0]).hypot(other[1] - at[1]) < 0.12);
            let (sum, count) = around.fold((0.0, 0.0), |(sum, count), (_, top)| (sum + top, count + 1.0));
            sum / count - top
        })
        .collect();
    depths.sort_unstable_by(|a, b| b.total_cmp(a));
    let tenth = depths.len() / 10;
    depths[..tenth].iter().sum::<f64>() / tenth as f64
}

/// Mean depth below the bed's first surface along the way that the tool is drawn between two times [m].
fn depth_along(s: &Simulation, from: f64, to: f64) -> f64 {
    let (plan, cell) = (s.plan(), s.plan().cell_widths[1]);
    let Motion::Keyframes { frames, .. } = &plan.scene.tool[0].motion else { return f64::NAN };
    let Shape::Box { max: Some([_, _, surface]), .. } = plan.scene.body[0].shape else { return f64::NAN };
    let drawn = frames.iter().filter(|frame| (from..=to).contains(&frame.time));
    let way: Vec<[f64; 2]> = drawn.map(|frame| [frame.position[0], frame.position[1]]).collect();
    let on_it = |at: [f64; 2]| way.iter().any(|x| (x[0] - at[0]).hypot(x[1] - at[1]) < cell);
    let grains: Vec<Grain> = s.spots().iter().map(Grain::of).collect();
    let map = HeightMap::new(&grains, &plan.scene.world, cell);
    let depths: Vec<f64> =
        map.heights().iter().enumerate().filter(|(i, _)| on_it(map.at(*i))).map(|(_, top)| surface - top).collect();
    depths.iter().sum::<f64>() / depths.len() as f64
}

/// All of `letters`: what is left of the S when the D is written.
///
/// Symptom: a robot that looks back finds its track gone, since the coarse grid has smoothed it. Physics: dry sand at rest keeps its
/// shape; the S is as deep as it was.
pub fn first_letter() -> Outcome {
    let mut outcome = Outcome::default();
    let scene = barchan::tasks::scene("letters", &[] as &[&str]).expect("letters is a scene");
    let mut s = Simulation::new(&barchan::registry(), &scene, &options(Precision::F32)).expect("letters can be run");
    run_to(&mut s, 1.6);
    let fresh = depth_along(&s, 0.16, 1.294);
    run_to(&mut s, scene.time.end);
    let kept = depth_along(&s, 0.16, 1.294);
    println!("S: {:.2} mm deep when drawn, {:.2} mm at the end", 1e3 * fresh, 1e3 * kept);
    outcome.steps = s.step_count();
    outcome.add("depth of the fresh S, short of 15 mm by [mm]", 15.0 - 1e3 * fresh, 0.0);
    outcome.add("share of the S's depth lost by the end", 1.0 - kept / fresh, 0.3);
    outcome
}
