//! Unbounded ground: only what is around agents is live, what they have changed is kept, the rest is a function of position.

use barchan::{Command, Ledger, Options, ParticleList, ParticleState, Precision, Scene, Simulation};
use barchan_tests::long_cases::{FURROW_CELL, furrow, furrow_depth, furrow_scene};
use barchan_tests::scenes::{options, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, body, material, tool};

fn step(s: &mut Simulation, count: u32) {
    (0..count).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
}

fn counted(ledger: &Ledger, name: &str) -> u64 {
    ledger.counts.get(name).copied().unwrap_or(0)
}

/// A furrow of 6 m; the example `long_cases` drags one of 100 m.
#[test]
fn a_furrow_stays_when_its_tool_is_gone() {
    furrow(6.0).check("furrow");
}

/// Symptom: an agent that comes back finds fresh ground, or ground that falls into itself as it wakes. Physics: it finds what it left.
#[test]
fn an_agent_that_comes_back_finds_its_furrow() {
    let mut s = simulation(&furrow_scene(8.0, 2.56), Precision::F32);
    run_to(&mut s, 0.8);
    let left = furrow_depth(&s.ground(), 0.6);
    let awake = furrow_depth(&s.particles(), 0.6);
    assert!(awake.is_nan(), "the furrow's first metre is out of reach, and {awake} m deep among the live particles");
    // Back through the air.
    for (velocity, time) in [([0.0, 0.0, 4.0], 0.15), ([-7.0, 0.0, 0.0], 0.4), ([0.0; 3], 0.1)] {
        s.act("ball", &Command::Twist { linear: velocity, angular: [0.0; 3] }).unwrap();
        let until = s.time() + time;
        run_to(&mut s, until);
    }
    let found = furrow_depth(&s.particles(), 0.6);
    let ledger = s.ledger();
    println!("left {left:.4} m deep, found {found:.4} m, {:?}", ledger.counts);
    assert!(counted(&ledger, "tiles brought back from the archive") > 0, "{:?}", ledger.counts);
    assert!(left > FURROW_CELL, "a furrow is deeper than a cell: {left}");
    within("furrow found on coming back: change of depth [cells]", (found - left).abs() / FURROW_CELL, 0.25);
}

/// The same agent in worlds of 10 to 80 m is the same simulation bit for bit: the same particles, blocks and bytes. Any pass, list or
/// sum over the world would show.
#[test]
fn the_size_of_the_world_changes_nothing() {
    let run = |side: f64| {
        let mut s = simulation(&furrow_scene(side, side), Precision::F32);
        step(&mut s, 80);
        let state = s.particles();
        let blocks = state.sort.as_ref().map_or(0, |sort| sort.blocks.len());
        println!("{side} m: {} particles in {blocks} blocks, {:?} bytes", s.particle_count(), s.memory());
        (rows(&s), blocks, s.memory(), state.archive)
    };
    let sides = [10.24, 20.48, 40.96, 81.92];
    let first = run(sides[0]);
    for side in &sides[1..] {
        assert!(run(*side) == first, "a world of {side} m differs from one of {} m", sides[0]);
    }
}

/// Hills under an agent that flies over them and touches nothing.
fn flight(subcycle: bool) -> String {
    let heights: Vec<Vec<f64>> = (0..=64)
        .map(|j| (0..=256).map(|i| 0.4 + 0.02 * (f64::from(i) * 0.4).sin() * (f64::from(j) * 0.3).cos()).collect())
        .collect();
    let ground =
        format!("height_field = {{ min = [-2.56, -2.56], max = [17.92, 2.56], bottom = 0.0, heights = {heights:?} }}");
    let walls = "z_min = \"stick\"";
    let head = Head { min: [-2.56, -2.56, 0.0], max: [17.92, 2.56, 2.56], ..Head::cells(FURROW_CELL, [0; 3], walls) };
    head.time("safety = 0.5").with(&[
        material("sand", 1600.0, "young_modulus = 3e5, friction_angle_deg = 35.0"),
        body("sand", &ground, "settled = true"),
        format!("[levels]\ncount = 3\nhalf = 8\nreach = 4\nsubcycle = {subcycle}\n"),
        tool(
            "eye",
            [0.0, 0.0, 0.6],
            "sphere = { radius = 0.05 }",
            "\"slip\"",
            "{ velocity = { linear = [4.0, 0.0, 0.0] } }",
        ),
    ])
}

/// Symptom: ground that nobody has touched fills the archive, or sags as it comes within reach. Physics: settled hills rest; particles
/// that were split and merged again are where they were; what has not changed is given back to the terrain, all but a few tiles.
#[test]
fn ground_that_nobody_touches_leaves_nothing_behind() {
    for subcycle in [false, true] {
        let mut s = simulation(&flight(subcycle), Precision::F32);
        let start = s.ledger();
        let mut fastest = 0f64;
        while s.time() < 0.8 {
            step(&mut s, 20);
            fastest = rows(&s).iter().flat_map(|r| r.v).fold(fastest, |most, v| most.max(v.abs()));
        }
        let end = s.ledger();
        println!("subcycle {subcycle}: fastest {fastest:.2e} m/s, {:?}", end.counts);
        assert!(counted(&end, "tiles brought in from the terrain") > 10 && counted(&end, "particles split") > 100);
        within("speed of hills that nobody touches [m/s]", fastest, 0.02);
        assert!(counted(&end, "tiles given back to the terrain") > 5, "{:?}", end.counts);
        // Leftovers that merged across the lattice's cubes have moved mass between them, which looks like a change.
        let [kept, dropped] =
            ["tiles archived", "tiles given back to the terrain"].map(|what| counted(&end, what) as f64);
        within("part of untouched tiles that is archived", kept / (kept + dropped), 0.25);
        within("mass less what came in, change", ((end.mass - end.seeded_mass) / start.mass - 1.0).abs(), 1e-6);
    }
}

/// Symptom: an agent that jumps leaves fine particles where they no longer belong, or takes its furrow along. Physics: all of what it
/// leaves is put away at once, and is there when it jumps back.
#[test]
fn an_agent_that_jumps_there_and_back_finds_its_furrow() {
    let frames = "frames = [{ time = 0.0, position = [0.0, 0.0, 0.24] }, { time = 0.2, position = [0.8, 0.0, 0.24] }, \
                  { time = 0.28, position = [0.8, 0.0, 0.64] }, { time = 0.2801, position = [6.0, 0.0, 0.64] }, \
                  { time = 0.32, position = [6.0, 0.0, 0.64] }, { time = 0.3201, position = [0.6, 0.0, 0.64] }], \
                  interpolation = \"linear\"";
    let text = furrow_scene(10.24, 2.56)
        .replace(
            "motion = { velocity = { linear = [4, 0.0, 0.0] } }",
            &format!("motion = {{ keyframes = {{ {frames} }} }}"),
        )
        .replace("safety = 0.5", "step = 5e-4\nover_bound = \"allow\"");
    assert!(text.contains("keyframes"), "{text}");
    let mut s = simulation(&text, Precision::F32);
    run_to(&mut s, 0.28);
    let left = furrow_depth(&s.particles(), 0.4);
    let around = |state: &ParticleState| {
        let own = |list: &ParticleList| (0..list.len()).filter(|i| (0.0..0.8).contains(&list.position(*i)[0])).count();
        state.lists.iter().map(own).sum::<usize>() as f64
    };
    let before = around(&s.particles());
    run_to(&mut s, 0.31);
    assert!(furrow_depth(&s.particles(), 0.4).is_nan(), "what was left is out of reach");
    let kept = furrow_depth(&s.ground(), 0.4);
    let fewer = around(&s.ground()) / before;
    run_to(&mut s, 0.33);
    let found = furrow_depth(&s.particles(), 0.4);
    println!("left {left:.4} m deep, kept {kept:.4} m, found {found:.4} m, {:?}", s.ledger().counts);
    // What had to be fine for the agent's sake, at the surface too, is kept coarser.
    within("particles that are kept, of those that were left", fewer, 0.5);
    within("depth that is kept, off by [cells]", (kept - left).abs() / FURROW_CELL, 0.1);
    within("depth that is found, off by [cells]", (found - left).abs() / FURROW_CELL, 0.25);
}

/// Everything that a run leaves: particles, the archive among them, and time; and what has come and gone.
fn left(s: &Simulation) -> (ParticleState, u64, Vec<(String, u64)>) {
    let counts = s.ledger().counts;
    (s.particles(), s.time().to_bits(), counts.into_iter().filter(|(name, _)| name.starts_with("tiles ")).collect())
}

/// A run that is interrupted while the archive holds ground, and goes on from its snapshot, is the run that was not; and so is one on
/// two threads. In f64, where what is kept must be too.
#[test]
fn a_run_resumes_across_the_archive_bit_for_bit() {
    let start = |threads: usize| {
        let options = Options { threads, ..options(Precision::F64) };
        let mut s = Simulation::new(&barchan::registry(), &scene(&furrow_scene(8.0, 2.56)), &options).unwrap();
        s.act("ball", &Command::Twist { linear: [6.0, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
        run_to(&mut s, 0.3);
        s
    };
    let mut whole = start(1);
    let before = whole.ledger();
    assert!(counted(&before, "tiles in the archive now") > 2, "{:?}", before.counts);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    whole.save(&file).unwrap();
    let mut resumed = Simulation::resume(&barchan::registry(), &file, &options(Precision::F64)).unwrap();
    assert!(left(&resumed) == left(&whole), "what is resumed is what was saved");
    let mut threaded = start(2);
    for s in [&mut whole, &mut resumed, &mut threaded] {
        // Back and forth, so that ground leaves the archive too.
        s.act("ball", &Command::Twist { linear: [-6.0, 0.0, 4.0], angular: [0.0; 3] }).unwrap();
        run_to(s, 0.5);
    }
    let ledger = whole.ledger();
    assert!(counted(&ledger, "tiles brought back from the archive") > 0, "{:?}", ledger.counts);
    assert!(left(&resumed) == left(&whole), "interrupted and whole runs differ");
    assert!(left(&threaded) == left(&whole), "one thread and two differ");
    let mass = |l: &Ledger| l.mass + l.deleted_mass - l.seeded_mass;
    within("f64: mass less what came in, change", (mass(&ledger) / mass(&before) - 1.0).abs(), 1e-12);
}

/// What cannot be unbounded is refused, with the key and what would mend it.
#[test]
fn what_cannot_be_unbounded_is_refused_by_name() {
    let whole = furrow_scene(8.0, 2.56);
    for (from, to, what) in [
        ("reach = 4", "reach = 3", "must be from 4 to"),
        ("count = 2", "count = 1", "needs levels to nest"),
        ("settled = true", "settled = false", "set body[0].settled = true"),
        ("settled = true", "velocity = [1.0, 0.0, 0.0]", "is no box, height_field or terrain at rest"),
        ("reach = 4", "reach = 4\nagents = []", "there is none"),
        ("y_min = \"slip\"\ny_max = \"slip\"", "y_min = \"periodic\"\ny_max = \"periodic\"", "y is periodic"),
    ] {
        let text = whole.replace(from, to);
        let error = Scene::from_str(&text, "unbounded", "").unwrap_err().to_string();
        assert!(error.contains("levels.reach") && error.contains(what), "{error}");
    }
    let plan = simulation(&whole, Precision::F32).plan().to_string();
    assert!(plan.contains("unbounded ground") && plan.contains("levels.reach = 4"), "{plan}");
}
