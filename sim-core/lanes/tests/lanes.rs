//! Every instruction set here against plain f64 arithmetic: elementary functions to their stated errors, the register moves
//! of the transfers exactly.
#![expect(
    clippy::undocumented_unsafe_blocks,
    reason = "every block loads from or stores to an array of 16 entries that is in plain sight"
)]

use barchan_lanes::{CHUNK, Dual, Float, Isa, Kernel, Lanes, Mask, Real, Row};

fn samples() -> Vec<f64> {
    let mut xs = vec![1.0, 0.75, 1.5, 2.0, 1.0 + 1e-7, 1.0 - 1e-7, 1e-6, 1e6, 0.5, 3.0, 0.999, 1.001];
    xs.extend((0..500).map(|i| 10f64.powf(-6.0 + 12.0 * f64::from(i) / 499.0)));
    xs.resize(xs.len().next_multiple_of(CHUNK), 1.0);
    xs
}

struct Elementary;
impl<T: Float> Kernel<T> for Elementary {
    type Output = (f64, f64);
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> (f64, f64) {
        let (mut ln_error, mut exp_error) = (0f64, 0f64);
        let mut out = [T::default(); CHUNK];
        for xs in samples().chunks(V::COUNT) {
            let x: Vec<T> = xs.iter().map(|&x| T::from_f64(x)).collect();
            let v = unsafe { V::load(x.as_ptr()) };
            unsafe { v.ln().store(out.as_mut_ptr()) };
            for (o, x) in out.iter().zip(&x) {
                let exact = x.to_f64().ln();
                ln_error = ln_error.max(
                    (o.to_f64() - exact).abs() / exact.abs().max(1e-300) / T::EPSILON
                        * f64::from(u8::from(exact != 0.0)),
                );
            }
            let y: Vec<T> = xs.iter().map(|&x| T::from_f64(x.ln() * 5.0)).collect();
            unsafe { V::load(y.as_ptr()).exp().store(out.as_mut_ptr()) };
            for (o, y) in out.iter().zip(&y) {
                let exact = y.to_f64().exp();
                exp_error = exp_error.max((o.to_f64() - exact).abs() / exact / T::EPSILON);
            }
        }
        (ln_error, exp_error)
    }
}

#[test]
fn logarithm_and_exponential_keep_their_stated_error_on_every_instruction_set() {
    for isa in Isa::available() {
        for (ln, exp) in [isa.run::<f32, _>(Elementary), isa.run::<f64, _>(Elementary)] {
            println!("{}: ln {ln:.2} ulp, exp {exp:.2} ulp", isa.name());
            assert!(ln < 2.5, "{}: ln is off by {ln} ulp", isa.name());
            assert!(exp < 2.0, "{}: exp is off by {exp} ulp", isa.name());
        }
    }
}

/// The lanes of a register, as plain numbers.
fn read<R: Row>(row: R) -> Vec<f64> {
    let mut out = [R::Scalar::default(); CHUNK];
    unsafe { row.store(out.as_mut_ptr()) };
    out[..4 * R::NODES].iter().map(|x| x.to_f64()).collect()
}

fn scalars<T: Float>(value: impl Fn(usize) -> f64) -> [T; CHUNK] {
    core::array::from_fn(|i| T::from_f64(value(i)))
}

/// What each lane must hold.
fn assert_lanes<R: Row>(row: R, expected: impl Fn(usize) -> f64) {
    assert_eq!(read(row), (0..4 * R::NODES).map(expected).collect::<Vec<_>>());
}

struct Moves;
impl Moves {
    /// What all parts of a row can do.
    fn of_row<R: Row>() {
        let numbers = scalars::<R::Scalar>(|i| i as f64 + 1.0);
        let row = unsafe { R::load(numbers.as_ptr()) };
        assert_lanes(row, |i| i as f64 + 1.0);
        assert_lanes(unsafe { R::repeat4(numbers.as_ptr()) }, |i| (i % 4 + 1) as f64);
        assert_lanes(unsafe { R::spread(numbers.as_ptr()) }, |i| (i / 4 + 1) as f64);
        assert_lanes(R::fill(numbers[6]), |_| 7.0);
        assert_lanes(row + row * row, |i| (i as f64 + 1.0) * (i as f64 + 2.0));
        assert_lanes(-row, |i| -(i as f64 + 1.0));
        let mut sum = row;
        sum.add_product(row, R::fill(numbers[2]));
        sum += row;
        assert_lanes(sum, |i| 5.0 * (i as f64 + 1.0));
    }
}
impl<T: Float> Kernel<T> for Moves {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        assert!(CHUNK.is_multiple_of(V::COUNT) && V::COUNT.is_multiple_of(4));
        Self::of_row::<V>();
        Self::of_row::<V::Near>();
        Self::of_row::<V::Far>();

        let value = |i: usize, j: usize| (i * CHUNK + j) as f64;
        let make = |i: usize| unsafe { V::load(scalars(|j| value(i, j)).as_ptr()) };
        let mut rows: [V; 4] = core::array::from_fn(make);
        V::transpose4(&mut rows);
        for (c, &row) in rows.iter().enumerate() {
            assert_lanes(row, |i| value(i % 4, i / 4 * 4 + c));
        }
        // Rows of three nodes and zeros.
        let lines: [[T; CHUNK]; 4] = core::array::from_fn(|i| scalars(|j| if j < 12 { value(i, j * j) } else { 0.0 }));
        let (sum, difference) = unsafe { V::fold(lines.as_ptr().cast(), CHUNK) };
        let of = |i: usize, g: usize| lines[i / 4][4 * g + i % 4].to_f64();
        assert_lanes(sum, |i| of(i, 0) + of(i, 1) + of(i, 2));
        assert_lanes(difference, |i| of(i, 2) - of(i, 0));
        assert_lanes(make(1).fourth(), |i| value(1, i | 3));
        assert_eq!(make(1).sum().to_f64(), (16..16 + V::COUNT).sum::<usize>() as f64);
        assert_eq!(make(2).max_lane().to_f64(), (31 + V::COUNT) as f64);
        assert_eq!(make(0).lt(V::splat(3.0)).bits(), 0b111);
        assert_eq!((!make(0).le(V::splat(3.0))).bits(), u16::MAX >> (CHUNK - V::COUNT) & 0xfff0);
        assert!(make(0).is_finite().all() && !(make(0) / V::zero()).is_finite().any());
        assert_lanes(V::splat(2.5).round(), |_| 2.0);
        assert_lanes(V::splat(-2.5).abs(), |_| 2.5);
        assert!(read((V::zero() / V::zero()).exp()).iter().all(|x| x.is_nan()), "exp must not swallow NaN");
    }
}

#[test]
fn register_moves_do_what_they_say_on_every_instruction_set() {
    for isa in Isa::available() {
        isa.run::<f32, _>(Moves);
        isa.run::<f64, _>(Moves);
    }
}

/// Sixteen coordinates: read as fractions, moved, and looked up.
#[derive(Clone, Debug, PartialEq)]
struct Coordinates<T: Float> {
    offset: [T::Offset; CHUNK],
    cell: [i32; CHUNK],
    delta: [T; CHUNK],
    /// Bits of the fractions before the move; places of the cells after it, and whether any group of lanes has one outside.
    fraction: [u64; CHUNK],
    places: [u32; CHUNK],
    outside: bool,
}

const FIRST: [i32; 3] = [-3, 2, i32::MIN + 5];

impl<T: Float> Kernel<T> for Coordinates<T> {
    type Output = Self;
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(mut self) -> Self {
        let mut fraction = [T::default(); CHUNK];
        for at in (0..CHUNK).step_by(V::COUNT) {
            unsafe {
                let (offset, cell) = (self.offset[at..].as_mut_ptr(), self.cell[at..].as_mut_ptr());
                V::load_offset(offset).store(fraction[at..].as_mut_ptr());
                V::advance(offset, cell, V::load(self.delta[at..].as_ptr()));
                let cells = [cell.cast_const(); 3];
                self.outside |= V::places(cells, FIRST, [256, 32, 4], 5, self.places[at..].as_mut_ptr());
            }
        }
        self.fraction = fraction.map(|x| x.to_f64().to_bits());
        self
    }
}

/// Offsets and moves next to every place where the carry changes, and many at random.
fn coordinates<T: Float>() -> Vec<Coordinates<T>> {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let count = 2f64.powi(-32);
    let edges =
        [0.0, 1.0, 2.0, 127.0, 65_535.0, 65_536.0, 16_777_217.0, 2_147_483_647.0, 2_147_483_648.0, 4_294_967_295.0];
    let starts: Vec<f64> = edges.into_iter().map(|e| e * count).chain([1.0 - 2f64.powi(-53), 0.1, 0.5]).collect();
    let moves =
        [0.0, 0.5, 0.49, 0.3, 0.25, 1e-4, 1e-9, 2f64.powi(-33), 1.5 * count, 2.5 * count, 2f64.powi(-60), 1e-300];
    let cells = [0, -1, 7, i32::MAX - 1, i32::MIN + 1, FIRST[0] + 5];
    let mut pairs = Vec::new();
    for &start in &starts {
        for by in moves {
            pairs.extend([(start, by), (start, -by)]);
        }
    }
    pairs.extend((0..20_000).map(|_| (random(), random() - 0.5)));
    pairs.resize(pairs.len().next_multiple_of(CHUNK), (0.0, 0.0));
    let one = |(i, pairs): (usize, &[(f64, f64)])| Coordinates {
        offset: core::array::from_fn(|l| T::offset_from_f64(pairs[l].0).unwrap_or_default()),
        cell: core::array::from_fn(|l| cells[(i + l / 3) % cells.len()]),
        delta: scalars(|l| pairs[l].1),
        fraction: [0; CHUNK],
        places: [0; CHUNK],
        outside: false,
    };
    pairs.chunks(CHUNK).enumerate().map(one).collect()
}

/// Offsets are moved by whole counts with a carry into the cell: exactly what one number after the other gives, and within a count of the
/// distance asked for.
fn moves_agree<T: Float>() {
    for given in coordinates::<T>() {
        let plain = Isa::Baseline.run(given.clone());
        for i in 0..CHUNK {
            let (before, after) = (T::offset_to_f64(given.offset[i]), T::offset_to_f64(plain.offset[i]));
            assert!((0.0..1.0).contains(&after));
            let moved = f64::from(plain.cell[i].wrapping_sub(given.cell[i])) + after - before;
            let by = given.delta[i].to_f64();
            assert!((moved - by).abs() < 3e-10, "moved {moved} instead of {by}");
            assert!((f64::from_bits(plain.fraction[i]) - before).abs() <= T::EPSILON);
            let from_first = FIRST.map(|first| plain.cell[i].wrapping_sub(first));
            let place = (0..3).fold(0i32, |sum, d| sum.wrapping_add(from_first[d].wrapping_mul([256, 32, 4][d])));
            assert_eq!(plain.places[i], place as u32);
            assert!(plain.outside || from_first.iter().all(|x| (0..=5).contains(x)));
        }
        for isa in Isa::available() {
            let vector = isa.run(given.clone());
            assert_eq!(vector, plain, "{} in {}, from {given:?}", isa.name(), T::NAME);
        }
    }
}

#[test]
fn positions_move_by_the_same_bits_on_every_instruction_set() {
    moves_agree::<f32>();
    moves_agree::<f64>();
}

/// Cells at the edge of what is allowed, one lane at a time.
struct Edge(usize, i32);
impl Kernel<f32> for Edge {
    type Output = bool;
    #[inline(always)]
    fn run<V: Lanes<Scalar = f32>>(self) -> bool {
        let mut cells = [[3; CHUNK], [-4; CHUNK], [0; CHUNK]];
        cells[self.0 % 3][self.0 % V::COUNT] += self.1;
        let mut places = [0; CHUNK];
        let pointers = [cells[0].as_ptr(), cells[1].as_ptr(), cells[2].as_ptr()];
        unsafe { V::places(pointers, [3, -4, 0], [256, 32, 4], 5, places.as_mut_ptr()) }
    }
}

#[test]
fn one_cell_outside_is_seen_in_every_lane_and_along_every_axis() {
    for isa in Isa::available() {
        for lane in 0..3 * CHUNK {
            for (by, outside) in [(0, false), (5, false), (6, true), (-1, true), (i32::MAX - 4, true)] {
                assert_eq!(isa.run::<f32, _>(Edge(lane, by)), outside, "{}: lane {lane}, {by}", isa.name());
            }
        }
    }
}

#[test]
fn dual_numbers_give_the_derivatives_of_elementary_functions() {
    let x = Dual::new(1.7f64, [1.0, -2.0]);
    for (got, value, slope) in [
        (x.ln(), 1.7f64.ln(), 1.0 / 1.7),
        (x.exp(), 1.7f64.exp(), 1.7f64.exp()),
        (x.sqrt(), 1.7f64.sqrt(), 0.5 / 1.7f64.sqrt()),
        (x.recip(), 1.0 / 1.7, -1.0 / (1.7 * 1.7)),
        (x * x * x, 1.7f64.powi(3), 3.0 * 1.7 * 1.7),
        ((-x).abs(), 1.7, 1.0),
        (x.mul_add(x, x), 1.7 * 1.7 + 1.7, 4.4),
    ] {
        let [one, other] = got.derivatives;
        assert!((got.value - value).abs() < 1e-14 && (one - slope).abs() < 1e-13, "{got:?} {value} {slope}");
        assert!((other + 2.0 * slope).abs() < 2e-13, "{got:?} {slope}");
    }
    assert_eq!(Dual::new(0.0f64, [3.0]).sqrt().derivatives, [0.0]);
}
