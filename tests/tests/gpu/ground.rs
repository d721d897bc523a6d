//! Ground without levels: as on the CPU in 64 bits, against truths, and the same in many steps at once.

use super::levels::cut;
use super::{apart, column, cpu, gpu, gpu_of, jelly, momentum, passes_of, take, take_at_once};
use barchan::{Simulation, Spot, Vec3};
use barchan_tests::scenes::{Row, norm, rows, within};
use barchan_tests::sketch::{Head, PERIODIC, block, material};

/// 200 steps of a jelly against slip and sticking walls: the same positions as the CPU in 64 bits to a thousandth of a cell, and the
/// same impulses on its walls.
#[test]
fn a_jelly_bounces_as_on_the_cpu() {
    for walls in ["x_min = \"slip\"\nz_min = \"stick\"", "x_min = \"stick\"\nz_min = { separate = { friction = 0.3 } }"]
    {
        let (mut gpu, mut cpu) = (gpu(&jelly(walls)), cpu(&jelly(walls)));
        let start = cpu.ledger();
        take(&mut gpu, 200);
        take(&mut cpu, 200);
        println!("{walls}");
        let mut at_once = gpu_of(walls);
        take_at_once(&mut at_once, 200);
        within("distance if many steps are taken at once, in cells", apart(&rows(&at_once), &rows(&gpu)) / 0.02, 1e-4);
        let walls_gave = [at_once.ledger().wall_impulse, gpu.ledger().wall_impulse];
        let off = norm(std::array::from_fn::<f64, 3, _>(|d| walls_gave[0][d] - walls_gave[1][d]));
        within("impulse of walls if many steps are taken at once", off / norm(walls_gave[1]), 1e-4);
        within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.02, 1e-3);
        let (g, c) = (gpu.ledger(), cpu.ledger());
        let scale = momentum(&start);
        for d in 0..3 {
            let name = ["x", "y", "z"][d];
            within(
                &format!("impulse of walls along {name}"),
                (g.wall_impulse[d] - c.wall_impulse[d]).abs() / scale,
                2e-4,
            );
            let balance = g.momentum[d] - start.momentum[d] - g.wall_impulse[d] - g.gravity_impulse[d];
            within(&format!("balance of momentum along {name}"), balance.abs() / scale, 1e-4);
        }
        within("mass", (g.mass - c.mass).abs() / c.mass, 1e-6);
    }
}

/// Symptom: elastic energies of the two backends were a step apart. Physics: each is that of the end of the last step.
#[test]
fn energies_in_a_ledger_are_those_of_the_cpu() {
    let text = jelly("x_min = \"slip\"\nz_min = \"slip\"");
    let (mut gpu, mut cpu) = (gpu(&text), cpu(&text));
    for steps in [100, 7, 9] {
        take(&mut gpu, steps);
        take(&mut cpu, steps);
        let (a, b) = (gpu.ledger(), cpu.ledger());
        println!("{:.6} and {:.6} J elastic, {:.6} and {:.6} J kinetic", a.elastic, b.elastic, a.kinetic, b.kinetic);
        assert!(b.elastic > 0.05 * b.kinetic);
        within("elastic energy apart", (a.elastic - b.elastic).abs() / (b.elastic + b.kinetic), 1e-4);
    }
}

/// A jelly between walls that are so near that both fold onto the same nodes falls and squashes as on the CPU in 64 bits, to a ten-thousandth of a cell.
#[test]
fn between_walls_nearer_than_a_block_is_as_on_the_cpu() {
    for wide in [1, 2, 3] {
        let head = Head::cells(0.02, [wide, 12, 16], "x_min = \"slip\"\nx_max = \"stick\"\nz_min = \"slip\"");
        let far = [0.02 * wide as f64, 0.16, 0.15];
        let scene = head.time("step = 4e-4").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0, 0.06, 0.03], far, "velocity = [-0.3, 0.2, -1.0]"),
        ]);
        let (mut gpu, mut cpu) = (gpu(&scene), cpu(&scene));
        take_at_once(&mut gpu, 100);
        take(&mut cpu, 100);
        println!("{wide} wide");
        within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.02, 1e-4);
        let (g, c) = (gpu.ledger(), cpu.ledger());
        let off = norm(std::array::from_fn::<f64, 3, _>(|d| g.wall_impulse[d] - c.wall_impulse[d]));
        within("impulse of walls", off / norm(c.wall_impulse), 1e-4);
    }
}

/// A block that falls fast on a wall that lets go, in as many steps at once as the backend likes, sorts among them: as step by step.
#[test]
fn a_fast_block_lands_in_many_steps_at_once() {
    let toml =
        Head::cells(0.02, [16, 16, 24], "z_min = { separate = { friction = 0.3 } }").time("step = 4e-4").with(&[
            material("hencky", 1000.0, "young_modulus = 4e4, poisson_ratio = 0.3"),
            block("hencky", [0.1, 0.1, 0.13], [0.2, 0.2, 0.23], "velocity = [0.5, 0.2, -3.0]"),
        ]);
    let (mut many, mut single) = (gpu(&toml), gpu(&toml));
    take_at_once(&mut many, 200);
    take(&mut single, 200);
    within("distance, in cells", apart(&rows(&many), &rows(&single)) / 0.02, 1e-3);
    assert!(many.ledger().wall_impulse[2] > 0.0, "it has landed");
}

/// A jittered block that drifts by a tenth of a cell in 50 steps. Written down at once, steps hold sorts for particles that might become faster than they are: nobody needs
/// them, and not a bit is other than step by step, where only those are made that are due.
#[test]
fn sorts_that_nobody_needs_change_nothing() {
    let toml = Head { gravity: [0.0; 3], ..Head::space(0.05) }.time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        block("hencky", [0.0; 3], [0.2, 0.2, 0.2], "velocity = [0.1, 0.05, 0.0]\nsampling = \"jitter\""),
    ]);
    let (mut many, mut single) = (gpu(&toml), gpu(&toml));
    let start = rows(&many);
    take_at_once(&mut many, 200);
    take(&mut single, 200);
    let sorts = [&many, &single].map(|sim| passes_of(sim, "due"));
    println!("sorts at once and step by step: {sorts:?}");
    assert!(sorts[0] > sorts[1], "more sorts than are due: {sorts:?}");
    let (many, single) = (rows(&many), rows(&single));
    assert!((apart(&start, &many) - 0.2 * norm([0.1, 0.05, 0.0])).abs() < 1e-6, "it has flown");
    for (a, b) in many.iter().zip(&single) {
        assert_eq!((a.id, a.x, a.v, a.c), (b.id, b.x, b.v, b.c), "particle {}", a.id);
    }
}

/// Free flight over many cells, through the edges of blocks, in a periodic world: positions are exact to f32's velocity, and no
/// angular momentum appears.
#[test]
fn a_spinning_block_flies_far() {
    let toml = Head { gravity: [0.0; 3], ..Head::space(0.05) }.time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        block("hencky", [0.0; 3], [0.2, 0.2, 0.2], "velocity = [3.0, -2.0, 1.0]"),
    ]);
    let mut sim = gpu(&toml);
    let start = rows(&sim);
    take(&mut sim, 300);
    let end = rows(&sim);
    let moved = [0.9, -0.6, 0.3];
    let error = start
        .iter()
        .zip(&end)
        .fold(0.0f64, |most, (a, b)| most.max(norm(std::array::from_fn::<f64, 3, _>(|d| b.x[d] - a.x[d] - moved[d]))));
    within("flight of 22 cells, error in cells", error / 0.05, 1e-4);

    let toml = Head { max: [0.8; 3], min: [0.0; 3], walls: PERIODIC, ..Head::space(0.05) }.time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        block("hencky", [0.3; 3], [0.5; 3], "velocity = [3.0, -2.0, 1.0]"),
    ]);
    let mut sim = gpu(&toml);
    let before = sim.ledger();
    take(&mut sim, 400);
    let after = sim.ledger();
    let change: Vec3 = std::array::from_fn(|d| after.momentum[d] - before.momentum[d]);
    within("momentum round a periodic world", norm(change) / momentum(&before), 1e-5);
    within("mass", (after.mass - before.mass).abs() / before.mass, 1e-12);
}

/// Heights of columns of cells [m].
fn heights(rows: &[Row]) -> Vec<f64> {
    let mut heights = vec![0.0f64; 30];
    for row in rows {
        let i = ((row.x[0] / 0.02) as usize).min(29);
        heights[i] = heights[i].max(row.x[2]);
    }
    heights
}

#[test]
fn sand_collapses_to_the_same_heap() {
    let (mut gpu, mut cpu) = (gpu(&column()), cpu(&column()));
    take(&mut gpu, 800);
    take(&mut cpu, 800);
    let (g, c) = (heights(&rows(&gpu)), heights(&rows(&cpu)));
    let mean = g.iter().zip(&c).map(|(a, b)| (a - b).abs()).sum::<f64>() / 30.0;
    within("mean difference of heights, in cells", mean / 0.02, 0.1);
    let centre = |rows: &[Row]| rows.iter().map(|r| r.x[0]).sum::<f64>() / rows.len() as f64;
    within("difference of the centre, in cells", (centre(&rows(&gpu)) - centre(&rows(&cpu))).abs() / 0.02, 0.02);
}

/// So many particles leave their cells between two sorts that the lists of those that have do not hold them; and cells hold so many that threads share them. None is lost.
#[test]
fn crowds_that_leave_their_cells_are_not_lost() {
    // 64 a cell, and 125 in a few.
    for (spacing, half) in [(0.01, 0.12), (0.008, 0.06)] {
        let toml = Head { gravity: [0.0; 3], ..Head::space(0.04) }.time("step = 2e-4").with(&[
            material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block(
                "hencky",
                [-half; 3],
                [half; 3],
                &format!("spacing = {spacing}\nvelocity = [4.0, 5.0, 0.0]\nangular_velocity = [0.0, 5.0, 20.0]"),
            ),
        ]);
        let (mut gpu, mut cpu) = (gpu(&toml), cpu(&toml));
        take(&mut gpu, 60);
        take(&mut cpu, 60);
        within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.04, 1e-3);
    }
}

/// What is downloaded and uploaded again is the same to the last bit, far from the origin too.
#[test]
fn a_copy_is_exact() {
    let far = Head { min: [9_999.0, -1.0, -1.0], max: [10_001.0, 1.0, 1.0], ..Head::space(0.02) }.time("step = 1e-4");
    let toml = far.with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
        block("sand", [10_000.0, 0.0, 0.0], [10_000.1, 0.1, 0.1], "velocity = [0.3, 0.1, 0.0]\nsampling = \"jitter\""),
    ]);
    let mut sim = gpu(&toml);
    take(&mut sim, 30);
    let copy = sim.particles();
    sim.set_particles(copy.clone()).unwrap();
    assert!(sim.particles() == copy, "a copy differs");
    let mut fresh = copy.clone();
    fresh.sort = None;
    sim.set_particles(fresh).unwrap();
    let [mut a, mut b] = [&copy, &sim.particles()].map(|state| state.lists[0].id.clone());
    assert!(a != b, "a fresh sort follows where particles have gone");
    a.sort_unstable();
    b.sort_unstable();
    assert!(a == b, "and loses none");
}

/// Places and sizes, which pictures ask for, and the particles of some of the ground are those of the whole copy; with several materials, and
/// with several levels.
#[test]
fn parts_of_a_copy_are_as_in_the_whole() {
    let mixed = Head::cells(0.02, [12, 12, 16], "").time("step = 2e-4").with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
        material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
        block("sand", [0.0; 3], [0.24, 0.24, 0.1], "sampling = \"jitter\""),
        block("neo_hookean", [0.06, 0.06, 0.1], [0.16, 0.16, 0.2], "velocity = [0.3, 0.1, -1.0]"),
    ]);
    for toml in [mixed, cut(3, "jitter")] {
        let mut sim = gpu(&toml);
        take(&mut sim, 10);
        let whole = sim.particles();
        let spots: Vec<Spot> = whole.lists.iter().flat_map(|l| (0..l.len()).map(|i| l.spot(i))).collect();
        assert!(sim.spots() == spots, "other places");
        let is_low = |spot: &Spot| spot.position[2] < 0.12;
        let some = sim.ground_where(&is_low);
        let mut wanted = whole.lists;
        wanted.iter_mut().for_each(|list| list.retain(is_low));
        assert!(some.lists == wanted && wanted.iter().any(|list| list.len() > 1000), "other particles");
    }
}

/// Two materials of different kinds of strain, one falling on the other under gravity that grows: as on the CPU.
#[test]
fn materials_of_both_kinds_meet_as_on_the_cpu() {
    let toml = Head { gravity_ramp: 0.02, ..Head::cells(0.02, [16, 16, 20], "z_min = \"stick\"") }
        .time("step = 2e-4")
        .with(&[
            material("fixed_corotated", 1000.0, "young_modulus = 4e4, poisson_ratio = 0.3"),
            material("hencky", 600.0, "young_modulus = 2e4, poisson_ratio = 0.2"),
            block("fixed_corotated", [0.08, 0.08, 0.0], [0.2, 0.2, 0.08], ""),
            block("hencky", [0.1, 0.1, 0.09], [0.16, 0.16, 0.15], "velocity = [0.0, 0.0, -1.0]"),
        ]);
    let (mut gpu, mut cpu) = (gpu(&toml), cpu(&toml));
    take(&mut gpu, 200);
    take(&mut cpu, 200);
    within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.02, 1e-3);
}

/// Particles that leave through an open side are put back and stopped, with the impulse booked, or deleted, with the mass booked: as on the CPU,
/// but for when sorts find them.
#[test]
fn particles_that_leave_are_clamped_or_deleted_as_on_the_cpu() {
    let toml = |leaving: &str| {
        let world = format!("leaving = \"{leaving}\"");
        let head = Head { world: &world, gravity: [0.0; 3], ..Head::cells(0.02, [12; 3], "z_min = \"slip\"") };
        head.time("step = 1e-3").with(&[
            material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.2"),
            block("hencky", [0.1, 0.06, 0.0], [0.16, 0.12, 0.06], "velocity = [2.0, 0.3, 0.0]"),
        ])
    };
    let (mut g, mut c) = (gpu(&toml("delete")), cpu(&toml("delete")));
    let before = g.ledger();
    let mut partly = 0;
    for _ in 0..20 {
        take(&mut g, 8);
        take(&mut c, 8);
        let (now, there) = (g.ledger(), c.ledger());
        within("mass there is and was", ((now.mass + now.deleted_mass) / before.mass - 1.0).abs(), 1e-6);
        assert_eq!(
            now.particles + now.counts.get("particles deleted on leaving").copied().unwrap_or(0),
            before.particles
        );
        assert_eq!(now.particles as usize, g.particle_count());
        // Eight steps of a particle's way in the block are a quarter of it.
        within(
            "particles beside the CPU's",
            now.particles.abs_diff(there.particles) as f64 / before.particles as f64,
            0.35,
        );
        partly += u32::from(now.particles > 0 && now.particles < before.particles);
    }
    assert!(partly > 0 && g.ledger().particles == 0 && c.ledger().particles == 0, "{partly}");

    let (mut g, mut c) = (gpu(&toml("clamp")), cpu(&toml("clamp")));
    let before = g.ledger();
    take(&mut g, 160);
    take(&mut c, 160);
    let (now, there) = (g.ledger(), c.ledger());
    println!("{:?} {:?}", now.counts, there.counts);
    assert!(now.counts["particles put back into the world"] > 0, "{:?}", now.counts);
    assert!(rows(&g).iter().all(|r| r.x.iter().all(|x| (-0.03..0.27).contains(x))));
    let balance: Vec3 = std::array::from_fn(|d| now.momentum[d] - before.momentum[d] - now.wall_impulse[d]);
    within("balance of momentum", norm(balance) / momentum(&before), 1e-5);
    within("impulse on the side", (now.wall_impulse[0] / there.wall_impulse[0] - 1.0).abs(), 0.02);
    let centre = |sim: &Simulation| rows(sim).iter().map(|r| r.x[0]).sum::<f64>() / sim.particle_count() as f64;
    within("centre beside the CPU's, in cells", (centre(&g) - centre(&c)).abs() / 0.02, 0.05);
}
