//! What crosses the C boundary when things go wrong, and that the conformance suite sees materials that misbehave.
#![expect(unsafe_code, reason = "tables are trusted to obey the ABI, and some tests call them directly")]

use barchan_material_kit::abi::*;
use barchan_material_kit::*;

/// Linear in b − I; each parameter turns on one fault.
struct Faulty<const FAULT: u8>;

const PANICS: u8 = 1;
const STRESSED_AT_REST: u8 = 2;
const LOOKS_AT_NEIGHBOURS: u8 = 3;
const NOT_IDEMPOTENT: u8 = 4;
const WRONG_ENERGY: u8 = 5;
const ANISOTROPIC: u8 = 6;
const WRONG_MODULI: u8 = 7;
const HIDES_NAN: u8 = 8;

impl<const FAULT: u8> Material for Faulty<FAULT> {
    const NAME: &'static str = "faulty";
    const DOC: &'static str = "A material with a fault.";
    const REFERENCE: &'static str = "";
    const PARAMS: &'static [Param] = &[young_modulus(1e5)];
    const CAPABILITIES: u64 = BARCHAN_CAP_HARDENS;
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = T;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> T {
        // Longer than the buffers below, and with a character of several bytes where they end.
        assert!(FAULT != PANICS, "é{}é", "é".repeat(300));
        params[0]
    }

    #[inline(always)]
    fn update<T: Real>(law: &T, x: MatIn<T, SymMat3<T>>, _state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let mut strain = x.strain;
        let excess = x.strain.add_scalar(-T::one());
        let mut modulus = *law;
        if FAULT == LOOKS_AT_NEIGHBOURS && excess.xx.gt(T::splat(0.1)).any() {
            modulus *= T::splat(1.5);
        }
        if FAULT == NOT_IDEMPOTENT {
            strain = excess.scale(T::splat(0.5)).add_scalar(T::one());
        }
        let mut stress = excess.scale(modulus);
        if FAULT == STRESSED_AT_REST {
            stress = stress.add_scalar(modulus * T::splat(1e-3));
        }
        if FAULT == ANISOTROPIC {
            stress.xx += excess.yy * modulus * T::splat(1e-3);
        }
        if FAULT == HIDES_NAN {
            strain.xy = strain.xy.max(T::splat(-10.0));
        }
        MatOut::new(strain, stress)
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &T, b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        // The stress follows b, and no eigenvalue of b is above its greatest sum of a row's sizes.
        let (xy, xz, yz) = (b.xy.abs(), b.xz.abs(), b.yz.abs());
        let most = (b.xx + xy + xz).max(b.yy + xy + yz).max(b.zz + xz + yz);
        let two = (*law + *law) * most;
        TangentModuli { p_wave: two, triple_bulk: if FAULT == WRONG_MODULI { *law } else { two } }
    }

    /// τ = E (b − I) derives from ½ E (tr b − ln det b − 3).
    #[inline(always)]
    fn energy<T: Real>(law: &T, b: SymMat3<T>, _state: &[T]) -> T {
        let factor = T::splat(if FAULT == WRONG_ENERGY { 0.4 } else { 0.5 });
        factor * *law * (b.add_scalar(-T::one()).trace() - b.determinant().max(T::splat(1e-24)).ln())
    }
}

fn subject<const FAULT: u8>() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<Faulty<FAULT>>()) }.expect("a table of this version")
}

fn violation<const FAULT: u8>() -> &'static str {
    let subject = subject::<FAULT>();
    match conformance::run_all(&subject, &subject.default_params()) {
        Ok(_) => "",
        Err(violation) => {
            println!("{violation}");
            violation.check
        }
    }
}

#[test]
fn the_suite_names_what_a_material_does_wrong() {
    assert_eq!(violation::<0>(), "");
    assert_eq!(violation::<STRESSED_AT_REST>(), "no stress at the identity");
    assert_eq!(violation::<LOOKS_AT_NEIGHBOURS>(), "a particle's result is its own, bit by bit");
    assert_eq!(violation::<NOT_IDEMPOTENT>(), "dt = 0 is idempotent in f64");
    assert_eq!(violation::<WRONG_ENERGY>(), "stress is the derivative of the energy");
    assert_eq!(violation::<ANISOTROPIC>(), "stress turns with the frame");
    assert_eq!(violation::<WRONG_MODULI>(), "tangent moduli at rest");
}

/// A NaN that a material happens to swallow (max with a number) must be reported all the same: the kit looks at what it
/// reads as well as at what it writes.
#[test]
fn a_swallowed_nan_is_reported() {
    assert_eq!(violation::<HIDES_NAN>(), "");
}

#[test]
fn a_panic_becomes_a_status_with_its_text_cut_at_a_character_boundary() {
    let params = [1.0];
    for capacity in [0, 1, 2, 3, 100, 101] {
        let mut message = vec![b'#'; capacity + 1];
        let mut error = BarchanError {
            struct_size: size_of::<BarchanError>(),
            message: message.as_mut_ptr(),
            capacity,
            len: 0,
            particle: 7,
        };
        let batch = BarchanBatchF64 {
            struct_size: size_of::<BarchanBatchF64>(),
            n: 0,
            stride: 0,
            dt: 0.0,
            params: params.as_ptr(),
            strain_trial: std::ptr::null(),
            vel_grad: std::ptr::null(),
            state_in: std::ptr::null(),
            strain: std::ptr::null_mut(),
            kirchhoff: std::ptr::null_mut(),
            state_out: std::ptr::null_mut(),
        };
        let update = vtable::<Faulty<PANICS>>().update_f64.expect("an update");
        // SAFETY: a batch of no particles, and an error struct with a buffer of `capacity` bytes.
        let status = unsafe { update(&batch, &mut error) };
        assert_eq!(status, BARCHAN_E_PANIC);
        // Every character of the text has two bytes.
        assert_eq!(error.len, capacity / 2 * 2);
        assert_eq!(std::str::from_utf8(&message[..error.len]), Ok("é".repeat(capacity / 2).as_str()));
        assert_eq!(message[capacity], b'#', "nothing is written behind the buffer");
        assert_eq!(error.particle, u64::MAX);
    }
}

#[test]
fn a_short_error_struct_is_left_alone() {
    let mut error = BarchanError { struct_size: 8, message: std::ptr::null_mut(), capacity: 9, len: 3, particle: 7 };
    let update = vtable::<Faulty<0>>().update_f64.expect("an update");
    // SAFETY: a NULL batch is to be refused.
    assert_eq!(unsafe { update(std::ptr::null(), &mut error) }, BARCHAN_E_OTHER);
    assert_eq!((error.len, error.particle), (3, 7));
}
