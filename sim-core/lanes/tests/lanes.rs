//! Every instruction set here against plain f64 arithmetic: elementary functions to their stated errors, the register moves
//! of the transfers exactly.
#![expect(
    clippy::undocumented_unsafe_blocks,
    reason = "every block loads from or stores to an array of 16 entries that is in plain sight"
)]

use barchan_lanes::{Dual, Float, Isa, Kernel, LANES, Lanes, Mask, Real};

fn samples() -> Vec<f64> {
    let mut xs = vec![1.0, 0.75, 1.5, 2.0, 1.0 + 1e-7, 1.0 - 1e-7, 1e-6, 1e6, 0.5, 3.0, 0.999, 1.001];
    xs.extend((0..500).map(|i| 10f64.powf(-6.0 + 12.0 * f64::from(i) / 499.0)));
    xs.resize(xs.len().next_multiple_of(LANES), 1.0);
    xs
}

struct Elementary;
impl<T: Float> Kernel<T> for Elementary {
    type Output = (f64, f64);
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> (f64, f64) {
        let (mut ln_error, mut exp_error) = (0f64, 0f64);
        let mut out = [T::default(); LANES];
        for xs in samples().chunks(LANES) {
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

struct Moves;
impl<T: Float> Kernel<T> for Moves {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        let value = |i: usize, j: usize| (i * LANES + j) as f64;
        let read = |v: V| {
            let mut out = [T::default(); LANES];
            unsafe { v.store(out.as_mut_ptr()) };
            out.map(T::to_f64)
        };
        let make = |i: usize| {
            let row: Vec<T> = (0..LANES).map(|j| T::from_f64(value(i, j))).collect();
            unsafe { V::load(row.as_ptr()) }
        };
        let mut rows: [V; 4] = core::array::from_fn(make);
        V::transpose4(&mut rows);
        for (c, &row) in rows.iter().enumerate() {
            assert_eq!(read(row), core::array::from_fn(|i| value(i % 4, i / 4 * 4 + c)));
        }
        let four = [1.0, 2.0, 3.0, 4.0].map(T::from_f64);
        assert_eq!(read(unsafe { V::repeat4(four.as_ptr()) }), core::array::from_fn(|i| (i % 4 + 1) as f64));
        assert_eq!(
            read(unsafe { V::spread3(four.as_ptr()) }),
            core::array::from_fn(|i| if i < 12 { (i / 4 + 1) as f64 } else { 0.0 })
        );
        let lines: [[T; LANES]; 4] = core::array::from_fn(|i| core::array::from_fn(|j| T::from_f64(value(i, j * j))));
        let (sum, difference) = unsafe { V::fold4(core::array::from_fn(|i| lines[i].as_ptr())) };
        for i in 0..LANES {
            let of = |g: usize| lines[i / 4][4 * g + i % 4].to_f64();
            assert_eq!(read(sum)[i], of(0) + of(1) + of(2) + of(3));
            assert_eq!(read(difference)[i], of(2) - of(0));
        }
        assert_eq!(read(make(1).fourth()), core::array::from_fn(|i| value(1, i | 3)));
        assert_eq!(make(1).sum().to_f64(), (16..32).sum::<i32>() as f64);
        assert_eq!(make(2).max_lane().to_f64(), 47.0);
        assert_eq!(make(0).lt(V::splat(3.0)).bits(), 0b111);
        assert_eq!((!make(0).le(V::splat(3.0))).bits(), 0xfff0);
        assert!(make(0).is_finite().all() && !(make(0) / V::zero()).is_finite().any());
        assert_eq!(read(V::splat(2.5).round()), [2.0; LANES]);
        assert_eq!(read(V::splat(-2.5).abs()), [2.5; LANES]);
        assert!(read((V::zero() / V::zero()).exp()).iter().all(|x| x.is_nan()), "exp must not swallow NaN");

        let axis = |d: i32| -> [i32; LANES] { core::array::from_fn(|i| (i as i32 * (d + 1)) % 6 - 3) };
        let cells = [axis(0), axis(1), axis(2)];
        let (places, outside) =
            unsafe { V::places([cells[0].as_ptr(), cells[1].as_ptr(), cells[2].as_ptr()], [-3; 3], [256, 32, 4], 5) };
        assert!(!outside);
        for i in 0..LANES {
            let expected = (0..3).map(|d| (cells[d][i] + 3) * [256, 32, 4][d]).sum::<i32>();
            assert_eq!(places[i] as i32, expected);
        }
        for most in [4, 0] {
            let pointers = [cells[0].as_ptr(), cells[1].as_ptr(), cells[2].as_ptr()];
            assert!(unsafe { V::places(pointers, [-3; 3], [256, 32, 4], most) }.1);
        }
        assert!(unsafe { V::places([cells[0].as_ptr(); 3], [-2; 3], [1; 3], 5) }.1, "below the first");

        // Offsets: up, down, tiny, and across faces in both directions.
        let deltas = [0.0, 0.3, -0.3, 0.49, -0.49, 1e-9, -1e-9, 0.5, -0.5, -0.2, 0.25, -0.25, 0.4, -0.4, 1e-4, -1e-4];
        for start in [0.0, 0.1, 0.5, 0.999_999] {
            let mut offset = [T::offset_from_f64(start).unwrap(); LANES];
            let mut cell = [7; LANES];
            let delta = deltas.map(T::from_f64);
            unsafe { V::advance(offset.as_mut_ptr(), cell.as_mut_ptr(), V::load(delta.as_ptr())) };
            for i in 0..LANES {
                let (before, after) =
                    (T::offset_to_f64(T::offset_from_f64(start).unwrap()), T::offset_to_f64(offset[i]));
                assert!((0.0..1.0).contains(&after));
                let moved = f64::from(cell[i] - 7) + after - before;
                assert!((moved - delta[i].to_f64()).abs() < 3e-10, "moved {moved} instead of {}", deltas[i]);
            }
            let fractions = read(unsafe { V::load_offset(offset.as_ptr()) });
            for i in 0..LANES {
                assert!((fractions[i] - T::offset_to_f64(offset[i])).abs() <= T::EPSILON);
            }
        }
    }
}

#[test]
fn register_moves_do_what_they_say_on_every_instruction_set() {
    for isa in Isa::available() {
        isa.run::<f32, _>(Moves);
        isa.run::<f64, _>(Moves);
    }
}

#[test]
fn dual_numbers_give_the_derivatives_of_elementary_functions() {
    let x = Dual::new(1.7f64, 1.0);
    for (got, value, slope) in [
        (x.ln(), 1.7f64.ln(), 1.0 / 1.7),
        (x.exp(), 1.7f64.exp(), 1.7f64.exp()),
        (x.sqrt(), 1.7f64.sqrt(), 0.5 / 1.7f64.sqrt()),
        (x.recip(), 1.0 / 1.7, -1.0 / (1.7 * 1.7)),
        (x * x * x, 1.7f64.powi(3), 3.0 * 1.7 * 1.7),
        ((-x).abs(), 1.7, 1.0),
        (x.mul_add(x, x), 1.7 * 1.7 + 1.7, 4.4),
    ] {
        assert!((got.value - value).abs() < 1e-14 && (got.derivative - slope).abs() < 1e-13, "{got:?} {value} {slope}");
    }
    assert_eq!(Dual::new(0.0f64, 3.0).sqrt().derivative, 0.0);
}
