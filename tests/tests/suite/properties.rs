//! Properties that hold for any input, tried on random ones: splines, positions, snapshots. (Scene text: `sim-core/tests/scene.rs`.)

#![expect(unsafe_code, reason = "lanes are loaded from and stored to arrays of 16 by pointer")]

use barchan::state::Measured;
use barchan::{Options, ParticleState, Precision, Registry, Simulation, SortPhase};
use barchan_grid::spline::{first_distance, weights};
use barchan_lanes::{CHUNK, Float, Isa, Kernel, Lanes};
use barchan_tests::scenes::{scene, simulation};
use barchan_tests::sketch::{Head, block, material};
use barchan_tests::snapshots;
use proptest::prelude::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// Weights of 16 particles and their distances to the first node, lane by lane.
struct Weights([f64; CHUNK]);

impl<T: Float> Kernel<T> for Weights {
    type Output = [[f64; CHUNK]; 4];
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> [[f64; CHUNK]; 4] {
        let given = self.0.map(T::from_f64);
        let mut out = [[T::default(); CHUNK]; 4];
        for part in (0..CHUNK).step_by(V::COUNT) {
            // SAFETY: lanes divide the 16 scalars.
            unsafe {
                let f = V::load(given.as_ptr().add(part));
                let [a, b, c] = weights(f);
                for (out, v) in out.iter_mut().zip([a, b, c, first_distance(f)]) {
                    v.store(out.as_mut_ptr().add(part));
                }
            }
        }
        out.map(|out| out.map(T::to_f64))
    }
}

/// Value at `x` [cells of level 0] of the spline of node `i` on a level with cells twice as wide for each step up.
fn spline(i: i64, x: f64, level: i32) -> f64 {
    let x = x / 2f64.powi(level);
    let cell = x.floor();
    let at = i - cell as i64 + 1;
    if (0..3).contains(&at) { weights(x - cell)[at as usize] } else { 0.0 }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Momentum is exact since weights sum to one, affine fields since their first moment vanishes, and D = h²/4 is the second
    /// moment at every place in the cell: in either precision, in every instruction set, also next to the faces.
    #[test]
    fn splines_have_their_moments(mut f in prop::array::uniform16(0.0_f64..1.0), near in 0.0_f64..1e-6, at in 0..CHUNK) {
        f[at] = near;
        f[(at + 1) % CHUNK] = 1.0 - near;
        for isa in Isa::available() {
            for (w, tolerance) in [(isa.run::<f64, _>(Weights(f)), 1e-15), (isa.run::<f32, _>(Weights(f)), 5e-7)] {
                for lane in 0..CHUNK {
                    let [sum, first, second] = [0, 1, 2].map(|power| {
                        (0..3).map(|i| w[i][lane] * (w[3][lane] + i as f64).powi(power)).sum::<f64>()
                    });
                    prop_assert!((0..3).all(|i| w[i][lane] >= 0.0), "{isa:?}: {w:?}");
                    prop_assert!((sum - 1.0).abs() <= tolerance, "{isa:?}: sum {sum}");
                    prop_assert!(first.abs() <= tolerance, "{isa:?}: first moment {first}");
                    prop_assert!((second - 0.25).abs() <= tolerance, "{isa:?}: second moment {second}");
                }
            }
        }
    }

    /// With nodes at cell centres the spline of a coarse node is ¼, ¾, ¾, ¼ of four fine ones: level spaces nest. With nodes at
    /// cell corners it is not, and no exchange between levels could be exact.
    #[test]
    fn a_coarse_spline_is_a_sum_of_fine_ones(x in -50.0_f64..50.0, node in -26_i64..26) {
        let fine = [(2 * node - 1, 0.25), (2 * node, 0.75), (2 * node + 1, 0.75), (2 * node + 2, 0.25)];
        let sum: f64 = fine.iter().map(|&(i, share)| share * spline(i, x, 0)).sum();
        prop_assert!((sum - spline(node, x, 1)).abs() <= 1e-14);
    }
}

/// Moves 16 coordinates by as many distances, `count` times.
struct Move<'a, T: Float> {
    offset: &'a mut [T::Offset; CHUNK],
    cell: &'a mut [i32; CHUNK],
    delta: [T; CHUNK],
    count: u32,
}

impl<T: Float> Kernel<T> for Move<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        for part in (0..CHUNK).step_by(V::COUNT) {
            let (offset, cell) = (&mut self.offset[part..], &mut self.cell[part..]);
            for _ in 0..self.count {
                // SAFETY: as many entries as there are lanes.
                unsafe { V::advance(offset.as_mut_ptr(), cell.as_mut_ptr(), V::load(self.delta[part..].as_ptr())) };
            }
        }
    }
}

const CELL: f64 = 4_294_967_296.0;

/// Distances that a step may take, in cells: large ones, tiny ones, none.
fn delta() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -0.5_f64..=0.5,
        2 => (-32.0_f64..0.0, any::<bool>()).prop_map(|(power, back)| power.exp2() * if back { -0.5 } else { 0.5 }),
        1 => Just(0.0),
        1 => Just(0.5),
        1 => Just(-0.5),
    ]
}

/// Offsets, with the faces of the cell among them.
fn offset() -> impl Strategy<Value = u32> {
    prop_oneof![4 => any::<u32>(), 1 => Just(0), 1 => Just(u32::MAX), 1 => 0_u32..4]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Fixed-point positions: a move of at most half a cell is exact to one count of 2⁻³² cell, the cell carries, and the same
    /// move many times adds up without any rounding of its own, 10 km from the origin as at it. f32 positions lose a creep of
    /// 0.1 mm/s there altogether.
    #[test]
    fn fixed_point_positions_are_exact_to_a_count(
        start in prop::array::uniform16(offset()),
        cells in prop::array::uniform16(-2_000_000_i32..2_000_000),
        delta in prop::array::uniform16(delta()),
        count in 1_u32..40,
    ) {
        let delta = delta.map(|d| d as f32);
        for isa in Isa::available() {
            let (mut offset, mut cell) = (start, cells);
            isa.run::<f32, _>(Move { offset: &mut offset, cell: &mut cell, delta, count });
            for lane in 0..CHUNK {
                let place = |cell: i32, offset: u32| (i64::from(cell) << 32) + i64::from(offset);
                let moved = place(cell[lane], offset[lane]) - place(cells[lane], start[lane]);
                let counts = (f64::from(delta[lane]) * CELL).round_ties_even();
                // Half a cell is one count more than a signed 32-bit number holds.
                let off = (moved as f64 - counts * f64::from(count)).abs();
                let allowed = if counts.abs() >= CELL / 2.0 { f64::from(count) } else { 0.0 };
                prop_assert!(off <= allowed, "{isa:?}: {off} counts off after {count} moves of {}", delta[lane]);
            }
        }
    }

    /// Offsets in f64: never outside [0, 1), whatever rounding does at the faces, and cell and offset together are the sum to
    /// a few units in the last place.
    #[test]
    fn f64_positions_stay_in_their_cell(
        start in prop::array::uniform16(prop_oneof![4 => 0.0_f64..1.0, 1 => Just(0.0), 1 => Just(1.0 - f64::EPSILON / 2.0)]),
        cells in prop::array::uniform16(-2_000_000_i32..2_000_000),
        delta in prop::array::uniform16(prop_oneof![3 => delta(), 1 => (-1074.0_f64..-40.0, any::<bool>()).prop_map(|(p, back)| p.exp2() * if back { -1.0 } else { 1.0 })]),
        count in 1_u32..40,
    ) {
        for isa in Isa::available() {
            let (mut offset, mut cell) = (start, cells);
            isa.run::<f64, _>(Move { offset: &mut offset, cell: &mut cell, delta, count });
            for lane in 0..CHUNK {
                prop_assert!((0.0..1.0).contains(&offset[lane]), "{isa:?}: offset {:e}", offset[lane]);
                let moved = f64::from(cell[lane] - cells[lane]) + (offset[lane] - start[lane]);
                let off = (moved - delta[lane] * f64::from(count)).abs();
                prop_assert!(off <= 2e-15 * f64::from(count), "{isa:?}: {off:e} cells off after {count} moves of {:e}", delta[lane]);
            }
        }
    }
}

/// A small block; its particles are replaced below.
fn small() -> String {
    Head::space(0.1).with(&[material("snow", 400.0, ""), block("snow", [0.0; 3], [0.1, 0.1, 0.05], "")])
}

/// Changed snapshots that are tried of each seed.
const MUTATIONS: usize = 250;

fn registry() -> Registry {
    let mut registry = barchan::registry();
    barchan_seam_backend::register(&mut registry).unwrap();
    registry
}

/// Numbers of every kind: ordinary, exactly an f32, exactly a count of an offset, tiny, huge, signed zero.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        any::<f64>().prop_filter("NaN equals nothing", |x| !x.is_nan()),
        any::<f32>().prop_filter("NaN equals nothing", |x| !x.is_nan()).prop_map(f64::from),
        any::<u32>().prop_map(|counts| f64::from(counts) / CELL),
        Just(0.0),
        Just(-0.0),
    ]
}

/// A plane is stored in the least form that loses nothing, so whole planes of one kind must come up as well as mixed ones.
fn plane(n: usize) -> impl Strategy<Value = Vec<f64>> {
    prop_oneof![
        prop::collection::vec(number(), n),
        prop::collection::vec(any::<u32>().prop_map(|counts| f64::from(counts) / CELL), n),
        prop::collection::vec((-1e6_f32..1e6).prop_map(f64::from), n),
    ]
}

/// Offsets in the cell: any numbers of [0, 1), or counts of 2^-32.
fn inside(n: usize) -> impl Strategy<Value = Vec<f64>> {
    prop_oneof![
        prop::collection::vec(0.0_f64..1.0, n),
        prop::collection::vec(any::<u32>().prop_map(|counts| f64::from(counts) / CELL), n),
    ]
}

/// The farthest cell that a state may name.
const FAR: i32 = 1 << 30;

/// Any state that fits `template`'s lists.
fn state(template: &ParticleState) -> impl Strategy<Value = ParticleState> {
    let list = template.lists[0].clone();
    let (strains, states) = (list.strain.len(), list.state.len());
    (0_usize..40)
        .prop_flat_map(move |n| {
            let whole = (
                prop::collection::vec((any::<u64>(), any::<u16>(), [-FAR..=FAR, -FAR..=FAR, -FAR..=FAR]), n),
                (prop::collection::vec(inside(n), 3), prop::collection::vec(plane(n), 3 + 9 + 2 + strains + states)),
                number(),
                prop::option::of((
                    any::<u32>(),
                    (number(), prop::option::of((1e-9..1.0, any::<[i16; 3]>()))),
                    (number(), any::<u32>(), number(), number()),
                    prop::collection::vec((any::<[i32; 5]>(), any::<u32>(), any::<u16>()), 0..5),
                )),
            );
            (whole, Just(n))
        })
        .prop_map(move |((who, (mut planes, more), strain_dt, sort), n)| {
            planes.extend(more);
            let mut out = list.clone();
            let row = |first: usize, i: usize, d: usize| planes[first + d][i];
            out.id = who.iter().map(|w| w.0).collect();
            out.body = who.iter().map(|w| w.1).collect();
            out.cell = who.iter().map(|w| w.2).collect();
            out.offset = (0..n).map(|i| std::array::from_fn(|d| row(0, i, d))).collect();
            out.velocity = (0..n).map(|i| std::array::from_fn(|d| row(3, i, d))).collect();
            out.affine = (0..n).map(|i| std::array::from_fn(|d| row(6, i, d))).collect();
            (out.mass, out.volume0) = (planes[15].clone(), planes[16].clone());
            out.strain = planes[17..17 + strains].to_vec();
            out.state = planes[17 + strains..].to_vec();
            ParticleState {
                lists: vec![out],
                kept: Some(vec![(0..2 * n as u32).map(|i| i.wrapping_mul(0x9e37_79b9)).collect()]),
                levels: None,
                archive: Default::default(),
                strain_dt: if strain_dt.is_finite() { strain_dt } else { 0.0 },
                sort: sort.map(|(age, (drift, kept), (stiffness_bound, stiffness_age, mass, least_mass), blocks)| {
                    SortPhase {
                        measured: Measured { stiffness_bound, stiffness_age, mass, least_mass },
                        age,
                        rest: blocks.iter().map(|(.., rest)| *rest).collect(),
                        kept_for: vec![kept.map(|(dt, gravity)| (dt, gravity.map(f64::from)))],
                        drift: vec![drift],
                        blocks: blocks.into_iter().map(|(key, count, _)| (key, vec![count])).collect(),
                    }
                }),
            }
        })
}

fn resume(file: &Path, backend: &str) -> Result<Simulation, barchan::Error> {
    let options = Options { backend: backend.to_owned(), threads: 1, ..Options::default() };
    Simulation::resume(&registry(), file, &options)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Whatever numbers a state holds, a snapshot gives back the same bits: a backend that keeps f64 says so for all of them.
    /// A form chosen wrongly for one plane (f32 for what is not, counts for a negative zero) would change the run it resumes.
    #[test]
    fn snapshots_keep_every_bit_of_any_state(state in state(&simulation(&small(), Precision::F32).particles())) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("any.snapshot");
        let options = Options { backend: "dust".to_owned(), threads: 1, ..Options::default() };
        let mut s = Simulation::new(&registry(), &scene(&small()), &options).unwrap();
        s.set_particles(state.clone()).unwrap();
        s.save(&file).unwrap();
        let back = resume(&file, "dust").unwrap().particles();
        // Debug tells -0 from 0.
        prop_assert_eq!(format!("{back:?}"), format!("{state:?}"));
    }
}

/// Symptom: a snapshot with a right checksum and a level that its scene does not have panics on resuming. A checksum tells what a disk has done to a
/// file, not what a program has written into it: the reader believes nothing that it can hold against the scene, whatever the snapshot is
/// of. Two steps follow on whatever is accepted.
#[test]
fn what_a_snapshot_says_is_not_believed() {
    let folder = tempfile::tempdir().unwrap();
    let registry = barchan::registry();
    let (mut resumed, mut tried) = (0, 0);
    for name in snapshots::write_seeds(&registry, folder.path()).unwrap() {
        let good = std::fs::read(folder.path().join(&name)).unwrap();
        let file = folder.path().join("mutated");
        assert_eq!(snapshots::try_resume(&registry, &file, &snapshots::mended(&good)), Some(2), "{name}");
        let mut noise = barchan_tests::scenes::Noise::new(name.len() as u64);
        for round in 0..MUTATIONS {
            let mut bytes = good.clone();
            let what: Vec<_> = (0..1 + round % 2).map(|_| snapshots::mutate(&mut bytes, &mut noise)).collect();
            let went =
                catch_unwind(AssertUnwindSafe(|| snapshots::try_resume(&registry, &file, &snapshots::mended(&bytes))));
            let went = went.unwrap_or_else(|_| panic!("{name}, round {round}: it panics where {what:?}"));
            resumed += u32::from(went.is_some());
            tried += 1;
        }
        let mut level = good.clone();
        let list = level.windows(4).position(|tag| tag == b"LIST").unwrap() + 16;
        for wrong in [2_u32, 256, u32::MAX] {
            level[list + 4..list + 8].copy_from_slice(&wrong.to_le_bytes());
            std::fs::write(&file, snapshots::mended(&level)).unwrap();
            let error = resume(&file, "cpu").unwrap_err().to_string();
            assert!(error.contains("mutated: holds particles that do not fit") && error.contains("level"), "{error}");
        }
    }
    println!("{tried} snapshots with something else in them: {resumed} resumed, {} refused", tried - resumed);
    assert!(resumed * 20 > tried && resumed < tried, "the test must see both");
}

/// One byte of a snapshot may be wrong on a disk or a stick: every byte, changed in any way, must be found out, or a run goes on
/// from a state that never was.
#[test]
fn every_changed_byte_of_a_snapshot_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("small.snapshot");
    let mut s = simulation(&small(), Precision::F32);
    (0..3).for_each(|_| assert!(s.step().is_ok()));
    s.save(&file).unwrap();
    let good = std::fs::read(&file).unwrap();
    assert!(resume(&file, "cpu").is_ok());
    let (mut tried, mut noise) = (0, barchan_tests::scenes::Noise::new(1));
    for at in 0..good.len() {
        for mask in [1_u8 << (at % 8), 0xff, ((noise.draw() * 127.0) as i8 as u8) | 2] {
            let mut bytes = good.clone();
            bytes[at] ^= mask;
            std::fs::write(&file, &bytes).unwrap();
            match resume(&file, "cpu") {
                Err(barchan::Error::Snapshot { .. }) => tried += 1,
                Err(other) => panic!("byte {at} ^ {mask:#x} is refused, but as: {other}"),
                Ok(_) => panic!("byte {at} ^ {mask:#x} is accepted"),
            }
        }
    }
    println!("{} bytes, {tried} changes of one byte, {tried} refused", good.len());
}
