//! Another backend, or another number format, takes over in the middle of a run.

use barchan::{Options, Precision, Registry, Simulation};
use barchan_tests::scenes::{minus, norm, options, rows, scene, within};
use barchan_tests::sketch::{Head, bed, block, half, material, tool};

fn registry() -> Registry {
    let mut registry = barchan::registry();
    barchan_seam_backend::register(&mut registry).unwrap();
    registry
}

fn start(text: &str, options: &Options) -> Simulation {
    Simulation::new(&registry(), &scene(text), options).unwrap_or_else(|e| panic!("{e}"))
}

fn steps(s: &mut Simulation, count: u32) {
    (0..count).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
}

const H: f64 = 0.05;

/// An elastic block that falls on a slip floor and is hit by a free box.
fn struck(law: &str) -> String {
    let head = Head::cells(H, [16, 16, 24], "z_min = \"slip\"").time("step = 2e-4");
    head.with(&[
        material(law, 1000.0, "young_modulus = 5e4"),
        block(law, [0.3, 0.3, 0.0], [0.5, 0.5, 0.2], "sampling = \"jitter\""),
        tool(
            "box",
            [0.4, 0.4, 0.32],
            &half([0.08, 0.08, 0.1]),
            "{ coulomb = { friction = 0.3 } }",
            "{ free = { mass = 2, linear = [0.1, 0, -1] } }",
        ),
    ])
}

/// A swap that lost velocity, strain, the phase of the step or a body's momentum would show within a few steps: sound crosses
/// the block in 25. Against a run in f64 throughout, what f32 rounds away is all that may differ.
#[test]
fn an_elastic_body_goes_on_as_if_nothing_had_happened() {
    for law in ["neo_hookean", "fixed_corotated", "hencky"] {
        let (single, double) = (options(Precision::F32), options(Precision::F64));
        let mut whole = start(&struck(law), &double);
        let mut swapped = start(&struck(law), &single);
        steps(&mut swapped, 100);
        let before = (swapped.bodies(), swapped.wrenches(), swapped.time(), swapped.step_count(), swapped.ledger());
        swapped.swap(&registry(), &double).unwrap();
        let after = (swapped.bodies(), swapped.wrenches(), swapped.time(), swapped.step_count(), swapped.ledger());
        assert_eq!((&before.0, &before.1, before.2, before.3), (&after.0, &after.1, after.2, after.3));
        assert_eq!(before.4.gravity_impulse, after.4.gravity_impulse);
        assert_eq!(swapped.plan().precision, Precision::F64);
        steps(&mut swapped, 50);
        // And back again.
        swapped.swap(&registry(), &single).unwrap();
        steps(&mut swapped, 50);
        steps(&mut whole, 200);
        let far = rows(&whole).iter().zip(&rows(&swapped)).fold(0f64, |m, (a, b)| m.max(norm(minus(a.x, b.x))));
        let body = norm(minus(whole.bodies()[0].position, swapped.bodies()[0].position));
        assert!(norm(whole.wrenches()[0].force) > 1.0, "the box has met the block");
        within(&format!("{law}: greatest distance of a particle after 200 steps, in cells"), far / H, 1e-3);
        within(&format!("{law}: distance of the box, in cells"), body / H, 1e-3);
        let effects: Vec<_> = swapped.timings().into_iter().map(|t| t.effect).collect();
        assert!(effects.iter().any(|e| e == "P2G (cpu f32)") && effects.iter().any(|e| e == "P2G"), "{effects:?}");
    }
}

/// Swapping a backend for itself is no event at all.
#[test]
fn a_swap_to_the_same_backend_changes_no_bit() {
    let (head, mut parts) = bed(H, [12, 12], 3, 8, "young_modulus = 1e5, friction_angle_deg = 30");
    parts.push(tool(
        "rod",
        [0.3, 0.3, 0.15],
        &half([0.06; 3]),
        "{ coulomb = { friction = 0.4 } }",
        "{ velocity = { linear = [0.5, 0.2, -0.2] } }",
    ));
    let text = head.with(&parts);
    for precision in [Precision::F32, Precision::F64] {
        let mut whole = start(&text, &options(precision));
        let mut swapped = start(&text, &options(precision));
        steps(&mut whole, 60);
        steps(&mut swapped, 27);
        swapped.swap(&registry(), &options(precision)).unwrap();
        steps(&mut swapped, 33);
        assert_eq!(whole.particles(), swapped.particles(), "{precision}");
        assert_eq!((whole.wrenches(), whole.time()), (swapped.wrenches(), swapped.time()));
    }
}

/// A backend of another crate takes over and hands back; in free flight without strain all of them follow the parabola.
#[test]
fn a_backend_from_outside_takes_over_and_hands_back() {
    let dt = 2e-3;
    let head = Head { gravity: [0.0, 0.2, -9.81], ..Head::space(0.1).time(format!("step = {dt}")) };
    let text = head.with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4"),
        block("neo_hookean", [-0.2; 3], [0.2; 3], "velocity = [0.7, -0.3, 1.1]"),
    ]);
    let cpu = options(Precision::F64);
    let dust = Options { backend: "dust".to_owned(), ..cpu.clone() };
    let (mut whole, mut swapped) = (start(&text, &cpu), start(&text, &cpu));
    steps(&mut swapped, 30);
    swapped.swap(&registry(), &dust).unwrap();
    assert_eq!(swapped.backend(), "dust");
    steps(&mut swapped, 40);
    swapped.swap(&registry(), &cpu).unwrap();
    steps(&mut swapped, 30);
    steps(&mut whole, 100);
    let far = rows(&whole).iter().zip(&rows(&swapped)).fold(0f64, |m, (a, b)| m.max(norm(minus(a.x, b.x))));
    within("distance after 100 steps [m]", far, 1e-12);
}

/// A refused swap names what the other backend lacks, and the run goes on as if it had not been asked for.
#[test]
fn a_refused_swap_leaves_the_run_as_it_was() {
    let text = struck("hencky");
    let cpu = options(Precision::F32);
    let dust = Options { backend: "dust".to_owned(), ..cpu.clone() };
    let (mut whole, mut asked) = (start(&text, &cpu), start(&text, &cpu));
    steps(&mut whole, 40);
    steps(&mut asked, 20);
    let error = asked.swap(&registry(), &dust).unwrap_err().to_string();
    println!("{error}");
    assert!(error.contains("backend 'dust' (registered) has no forward form of the stage 'contact'"), "{error}");
    let abacus = Options { backend: "abacus".to_owned(), ..cpu.clone() };
    let error = asked.swap(&registry(), &abacus).unwrap_err().to_string();
    assert!(error.contains("no backend is called 'abacus'"), "{error}");
    steps(&mut asked, 20);
    assert_eq!(whole.particles(), asked.particles());
    assert_eq!(asked.backend(), "cpu");
}

fn on_gpu() -> Options {
    Options { backend: "wgpu".to_owned(), ..options(Precision::F32) }
}

/// From the CPU to a GPU and back, by swap and by snapshot: a block that bounces under a free box is where the CPU in f64 has it.
#[test]
fn an_elastic_body_goes_on_across_cpu_and_gpu() {
    let (single, double, gpu) = (options(Precision::F32), options(Precision::F64), on_gpu());
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("half.barchan");
    for law in ["neo_hookean", "fixed_corotated"] {
        let mut whole = start(&struck(law), &double);
        steps(&mut whole, 200);
        let there = |s: &Simulation, how: &str| {
            assert_eq!(s.step_count(), 200);
            let far = rows(&whole).iter().zip(&rows(s)).fold(0f64, |m, (a, b)| m.max(norm(minus(a.x, b.x))));
            let body = norm(minus(whole.bodies()[0].position, s.bodies()[0].position));
            within(&format!("{law}, {how}: greatest distance of a particle after 200 steps, in cells"), far / H, 1e-3);
            within(&format!("{law}, {how}: distance of the box, in cells"), body / H, 1e-3);
        };
        let mut s = start(&struck(law), &single);
        steps(&mut s, 70);
        s.swap(&registry(), &gpu).unwrap();
        assert_eq!(s.backend(), "wgpu");
        steps(&mut s, 70);
        s.save(&file).unwrap();
        let mut resumed = Simulation::resume(&registry(), &file, &single).unwrap();
        s.swap(&registry(), &single).unwrap();
        steps(&mut s, 60);
        there(&s, "swapped");
        steps(&mut resumed, 60);
        there(&resumed, "resumed from the GPU's snapshot");
        assert_eq!(s.particles(), resumed.particles(), "a swap is a snapshot without the file");

        let mut s = start(&struck(law), &single);
        steps(&mut s, 100);
        s.save(&file).unwrap();
        let mut resumed = Simulation::resume(&registry(), &file, &gpu).unwrap();
        steps(&mut resumed, 100);
        there(&resumed, "resumed from the CPU's snapshot");
    }
}

/// Sand forgets where each grain would have been, but not its heap: height and runout of a column that is swapped while it falls.
#[test]
fn a_heap_of_sand_is_the_same_heap_across_cpu_and_gpu() {
    let h = 0.02;
    let walls = "x_min = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let text = Head::cells(h, [24, 8, 14], walls).time("step = 2.5e-4").with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 30"),
        block("sand", [0.0; 3], [0.16, 0.16, 0.16], ""),
    ]);
    let mut whole = start(&text, &options(Precision::F64));
    steps(&mut whole, 600);
    let mut swapped = start(&text, &options(Precision::F32));
    steps(&mut swapped, 200);
    swapped.swap(&registry(), &on_gpu()).unwrap();
    steps(&mut swapped, 200);
    swapped.swap(&registry(), &options(Precision::F32)).unwrap();
    steps(&mut swapped, 200);
    let heights = |s: &Simulation| {
        let mut heights = [0f64; 24];
        for row in rows(s) {
            let column = ((row.x[0] / h) as usize).min(23);
            heights[column] = heights[column].max(row.x[2]);
        }
        heights
    };
    let (a, b) = (heights(&whole), heights(&swapped));
    assert!(a[7] < 0.8 * 0.16 && a[9] > 0.05, "the column, eight cells wide and high, has slumped: {a:?}");
    let mean = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / 24.0;
    within("mean difference of heights, in cells", mean / h, 0.02);
    let volume_gap = |s: &Simulation| rows(s).iter().map(|row| row.state[0] * row.volume0).sum::<f64>();
    let (a, b) = (volume_gap(&whole), volume_gap(&swapped));
    within("difference of the volume gained, relative", (a / b - 1.0).abs(), 0.01);
}

/// An adapter means nothing to a backend that runs on the processor: it says so instead of running elsewhere than asked.
#[test]
fn an_adapter_is_refused_by_a_backend_that_runs_on_none() {
    let options = Options { adapter: Some("H200".to_owned()), ..options(Precision::F32) };
    let error = Simulation::new(&registry(), &scene(&struck("hencky")), &options).unwrap_err().to_string();
    println!("{error}");
    assert!(error.contains("backend 'cpu'") && error.contains("the adapter 'H200' is asked for"), "{error}");
}
