//! Whatever agents do and particles are: regions nest, splits and merges keep what matter keeps, and a rim hands all of it on.

use barchan_core::Aabb;
use barchan_core::levels::{CellBox, Regions, SPLIT_AHEAD, Target};
use barchan_grid::block::{CELLS, NODES};
use barchan_grid::resample::{Particle, Planes, merge, split};
use barchan_grid::ring::{Carried, restrict};
use barchan_lanes::{CHUNK, Isa, Kernel, Lanes};
use barchan_tests::scenes::scene;
use barchan_tests::sketch::{Head, half, tool};
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;

const PLANES: Planes<'static> = Planes { is_gradient: false, merge: &[] };

fn particle() -> impl Strategy<Value = Particle> {
    let three = || prop::array::uniform3(-1.0_f64..1.0);
    (
        three(),
        three(),
        prop::array::uniform9(-3.0_f64..3.0),
        0.1_f64..3.0,
        0.01_f64..0.1,
        prop::array::uniform6(-0.1_f64..0.1),
    )
        .prop_map(|(x, v, c, mass, volume0, e)| Particle {
            x: Vector3::from(x),
            v: Vector3::from(v),
            c: Matrix3::from_row_slice(&c),
            mass,
            volume0,
            strain: [1.0 + e[0], 1.0 + e[1], 1.0 + e[2], e[3], e[4], e[5], 0.0, 0.0, 0.0],
            state: [0.0; barchan_grid::transfer::MAX_STATE],
        })
}

/// Mass, centre, momentum, angular momentum and kinetic energy, with the particles' own inertia.
fn totals(particles: &[Particle]) -> [f64; 11] {
    let mut sum = [0.0; 11];
    for p in particles {
        let inertia = p.side(PLANES).powi(2) / 12.0;
        let c = &p.c;
        let curl = Vector3::new(c[(2, 1)] - c[(1, 2)], c[(0, 2)] - c[(2, 0)], c[(1, 0)] - c[(0, 1)]);
        let l = (p.x.cross(&p.v) + curl * inertia) * p.mass;
        sum[0] += p.mass;
        for d in 0..3 {
            sum[1 + d] += p.mass * p.x[d];
            sum[4 + d] += p.mass * p.v[d];
            sum[7 + d] += l[d];
        }
        sum[10] += 0.5 * p.mass * (p.v.norm_squared() + inertia * c.norm_squared());
    }
    sum
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    /// A split keeps all of it, pulled together beside a tool all but energy and angular momentum, and its children merge into what
    /// it was. A lost affine part would show in the last four.
    #[test]
    fn splits_keep_everything_and_merge_back(parent in particle(), scale in 0.01_f64..1.0) {
        let before = totals(&[parent]);
        let after = totals(&split(&parent, PLANES, 1.0));
        prop_assert!(before.iter().zip(after).all(|(b, a)| (b - a).abs() < 1e-13 * (1.0 + b.abs())), "{before:?} {after:?}");
        let pulled = totals(&split(&parent, PLANES, scale));
        prop_assert!(before[..7].iter().zip(pulled).all(|(b, a)| (b - a).abs() < 1e-13 * (1.0 + b.abs())));
        let (back, change) = merge(&split(&parent, PLANES, 1.0), PLANES, 9.81, 0.1, true).unwrap();
        prop_assert!((back.x - parent.x).norm() < 1e-12 && (back.v - parent.v).norm() < 1e-12);
        prop_assert!((back.c - parent.c).norm() < 1e-11 && change.kinetic.abs() < 1e-12 * (1.0 + before[10]));
        prop_assert!(back.strain.iter().zip(parent.strain).all(|(a, b)| (a - b).abs() < 1e-12));
    }

    /// Symptom: spinning particles that overlap gain energy as they merge. Physics: any cluster that merges, be it all at one place, keeps
    /// mass, centre and momentum and gains no energy; what it changes of angular momentum and energy is what it says.
    #[test]
    fn merges_keep_mass_and_momentum_and_give_no_energy(
        mut cluster in prop::collection::vec(particle(), 2..9),
        apart in prop::sample::select(vec![1.0, 0.3, 0.01, 0.0]),
    ) {
        cluster.iter_mut().for_each(|p| p.x *= apart);
        // Gravity without end: nothing is refused for its motion.
        let (one, change) = merge(&cluster, PLANES, f64::INFINITY, 1.0, false).unwrap();
        let (before, after) = (totals(&cluster), totals(&[one]));
        prop_assert!(before[..7].iter().zip(after).all(|(b, a)| (b - a).abs() < 1e-12 * (1.0 + b.abs())), "{before:?} {after:?}");
        for d in 0..3 {
            prop_assert!((after[7 + d] - before[7 + d] - change.angular[d]).abs() < 1e-11);
        }
        prop_assert!((after[10] - before[10] - change.kinetic).abs() < 1e-11 * (1.0 + before[10]));
        prop_assert!(change.kinetic <= 1e-12, "a merge gave {} J", change.kinetic);
    }

    /// Whatever nodes are a rim, and whatever they hold, parents get all mass and momentum; and angular momentum, but for the spin of
    /// the affine part, which they get as momentum about themselves.
    #[test]
    fn rims_hand_on_mass_momentum_and_angular_momentum(
        slaves in any::<u64>(),
        values in prop::collection::vec(-1.0_f64..1.0, NODES),
        affine in prop::collection::vec(prop::array::uniform9(-1.0_f64..1.0), CELLS),
    ) {
        let mut carried = [Carried([0.0; CHUNK]); CELLS];
        let (mut before, mut spin) = ([0.0; 7], [0.0; 3]);
        for node in (0..CELLS).filter(|node| slaves >> node & 1 == 1) {
            let x = [node / 16, node / 4 % 4, node % 4].map(|i| i as f64);
            carried[node].0[..4].copy_from_slice(&values[4 * node..][..4]);
            add(&mut before, &carried[node].0[..4], x);
            for d in 0..3 {
                spin[d] += axial(&affine[node])[d];
                (0..3).for_each(|i| carried[node].0[Carried::<f64>::column(d) + i] = affine[node][3 * i + d]);
            }
        }
        let mut parents = [0.0; NODES];
        Isa::current().unwrap().run::<f64, _>(Restrict { carried: &mut carried, parents: &mut parents });
        let mut after = [0.0; 7];
        for node in 0..CELLS {
            let x = [node / 16, node / 4 % 4, node % 4].map(|i| 2.0 * i as f64 - 1.5);
            add(&mut after, &parents[4 * node..][..4], x);
        }
        for q in 0..4 {
            prop_assert!((before[q] - after[q]).abs() < 1e-11, "{before:?} {after:?}");
        }
        // Parents lie about a slave with second moment 3/4 fine cells squared along each axis.
        for d in 0..3 {
            prop_assert!((before[4 + d] + 0.75 * spin[d] - after[4 + d]).abs() < 1e-10, "{before:?} {spin:?} {after:?}");
        }
    }
}

/// [`restrict`] with the vectors of this machine.
struct Restrict<'a> {
    carried: &'a mut [Carried<f64>; CELLS],
    parents: &'a mut [f64; NODES],
}

impl Kernel<f64> for Restrict<'_> {
    type Output = ();
    fn run<V: Lanes<Scalar = f64>>(self) {
        restrict::<V>(self.carried, self.parents);
    }
}

/// Adds a node's momentum, mass, and moment of momentum.
fn add(sum: &mut [f64; 7], node: &[f64], x: [f64; 3]) {
    (0..4).for_each(|d| sum[d] += node[d]);
    (0..3).for_each(|d| sum[4 + d] += x[(d + 1) % 3] * node[(d + 2) % 3] - x[(d + 2) % 3] * node[(d + 1) % 3]);
}

/// Twice the axial vector of a matrix's skew part.
fn axial(c: &[f64; 9]) -> [f64; 3] {
    [c[7] - c[5], c[2] - c[6], c[3] - c[1]]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Up to three agents anywhere, near walls or out of the world, after a random walk: cells that are neighbours are at most one level apart, so that
    /// every particle is on one level and no three meet; and all parents of a node that a level's particles can reach, be it three cells
    /// out of the region, are free nodes of the next level: no rim hangs on a rim.
    #[test]
    fn regions_nest_wherever_agents_go(
        count in 2_u32..5,
        side in 4_u32..12,
        other in 4_u32..12,
        walks in prop::collection::vec(prop::array::uniform3(prop::array::uniform3(-2.4_f64..2.4)), 1..4),
        places in prop::collection::vec(prop::array::uniform3(-220_i32..220), 200),
    ) {
        let h = 0.01;
        let text = Head { min: [-2.56; 3], max: [2.56; 3], walls: "z_min = \"stick\"", ..Head::space(h) }.with(&[
            format!("[levels]\ncount = {count}\nhalf = {}\nagents = [\"a\"]\n", 2 * side),
            tool("a", [0.0; 3], &half([0.02; 3]), "\"slip\"", "\"fixed\""),
        ]);
        let scene = scene(&text);
        let world = CellBox { min: [-256; 3], max: [256; 3] };
        let mut regions = Regions::new(&scene, world);
        for stop in 0..3 {
            let around = |x: [f64; 3]| Aabb { min: x.map(|x| x - 0.02), max: x.map(|x| x + 0.02) };
            let halves = [side, other].map(|side| 2 * side).into_iter().cycle();
            let targets: Vec<Target> =
                walks.iter().zip(halves).map(|(walk, half)| Target { bounds: around(walk[stop]), half }).collect();
            regions.follow(&targets);
        }
        let near = |at: [i32; 3], n: i32| [at[0] + n % 3 - 1, at[1] + n / 3 % 3 - 1, at[2] + n / 9 - 1];
        // Random places say little: look at the faces of each level's boxes too.
        let mut all = places.clone();
        for (l, boxes) in regions.boxes().iter().enumerate() {
            for one in boxes {
                all.extend((0..20).map(|k| {
                    let inside: [i32; 3] = std::array::from_fn(|d| {
                        let width = one.max[d] - one.min[d];
                        one.min[d] - 3 + places[k][d].rem_euclid(width + 6)
                    });
                    inside.map(|c| c << l)
                }));
            }
        }
        for at in all {
            for margin in [0, SPLIT_AHEAD] {
                let level = regions.finest_at(at, margin);
                for n in 0..27 {
                    let by = near([0; 3], n).map(|o| o << level);
                    let other = regions.finest_at(std::array::from_fn(|d| at[d] + by[d]), margin);
                    prop_assert!(other.abs_diff(level) <= 1, "{at:?} on {level}, beside it {other}: {:?}", regions.boxes());
                }
            }
            let level = regions.finest_at(at, SPLIT_AHEAD);
            if level + 1 < regions.levels() {
                // A particle may have drifted by a cell, and reaches nodes one further.
                let cell = at.map(|c| c >> level);
                for n in 0..27 {
                    let node: [i32; 3] = std::array::from_fn(|d| cell[d] + 2 * near([0; 3], n)[d]);
                    let parent = node.map(|c| c >> 1);
                    // Parents are the parent cell's neighbours, and their support one cell more.
                    let support = CellBox { min: parent.map(|c| c - 2), max: parent.map(|c| c + 3) };
                    let free = (0..125).all(|k| regions.contains(level + 1, [support.min[0] + k % 5, support.min[1] + k / 5 % 5, support.min[2] + k / 25]));
                    prop_assert!(free, "node {node:?} of level {level}: {:?}", regions.boxes());
                }
            }
        }
    }
}
