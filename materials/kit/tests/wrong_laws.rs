//! Small laws that are wrong in one way each, and the check of the conformance suite that catches it.
#![expect(unsafe_code, reason = "tables come from `vtable`")]

use barchan_material_kit::conformance::{self, Outcome};
use barchan_material_kit::*;

/// Hencky elasticity and perfect plasticity beyond a fixed strain; what is dissipated is a state in J/m³. The parameter `fault` says what is wrong with
/// it; it is one law, and not one for each fault, because each is compiled for every instruction set.
struct Law<const VISCOUS: bool>;

const RIGHT: u8 = 0;
/// A state of 10⁻¹³ grows by half whenever it is asked.
const TINY_STATE_GROWS: u8 = 1;
/// Viscous stress of ∂v_x/∂y alone, which a spin has too.
const FEELS_SPIN: u8 = 2;
/// Its viscosity slot gives half of what the stress has.
const THIN_SLOT: u8 = 3;
/// Its viscosity is negative.
const NEGATIVE_VISCOSITY: u8 = 4;
/// Its stress stiffens with volume, its moduli stay.
const MODULI_STAY: u8 = 5;
/// Both stiffen: right if it declares that.
const HARDENS: u8 = 6;
/// Its shear relaxes with time: right if it declares that.
const CREEPS: u8 = 7;
/// It hardens by each call.
const COUNTS_CALLS: u8 = 8;
/// Packing it stiffens what it stores already.
const MAKES_ENERGY: u8 = 9;
/// Its energy is wrong where Poisson's ratio is negative.
const WRONG_IF_AUXETIC: u8 = 10;
/// Its elastic stress derives from no energy.
const NO_POTENTIAL: u8 = 11;
/// It is stiffer along z.
const ANISOTROPIC: u8 = 12;

const YIELD_STRAIN: f64 = 5e-3;
const RELAXATION_TIME: f64 = 1e-2;

/// Parameters of the law.
#[derive(Clone, Copy)]
struct Constants<T> {
    elastic: Lame<T>,
    poisson_ratio: T,
    fault: T,
}

impl<T: Real> Constants<T> {
    #[inline(always)]
    fn has(&self, fault: u8) -> T::Mask {
        (self.fault - T::splat(f64::from(fault))).abs().lt(T::splat(0.5))
    }

    /// `value` with that fault, 0 without.
    #[inline(always)]
    fn with(&self, fault: u8, value: T) -> T {
        T::select(self.has(fault), value, T::zero())
    }
}

impl<const VISCOUS: bool> Material for Law<VISCOUS> {
    const NAME: &'static str = "law";
    const DOC: &'static str = "A law with a fault.";
    const REFERENCE: &'static str = "";
    const PARAMS: &'static [Param] =
        &[young_modulus(1e5), poisson_ratio(0.3), param("fault", "1", 0.0, 0.0, 12.0, "What is wrong.")];
    const STATES: &'static [State] = &[
        state("dissipated", "J/m^3", 0.0, "Dissipated energy."),
        state("packed", "1", 0.0, "Greatest compression, or what calls have added."),
        state("tiny", "1", 1e-13, "What nothing but a fault changes."),
    ];
    const CAPABILITIES: u64 = if VISCOUS { BARCHAN_CAP_VEL_GRAD } else { 0 };
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = Constants<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> Constants<T> {
        Constants { elastic: Lame::new(params[0], params[1]), poisson_ratio: params[1], fault: params[2] }
    }

    #[inline(always)]
    fn update<T: Real>(law: &Constants<T>, x: MatIn<T, SymMat3<T>>, state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let (zero, one) = (T::zero(), T::one());
        let log = Hencky::of(x.strain);
        let deviator = log.strain.deviator();
        let trace = log.strain.trace();
        let norm = deviator.norm_squared().sqrt();
        let yield_strain = T::splat(YIELD_STRAIN) + law.with(NO_POTENTIAL, T::splat(1e9));
        let excess = norm - yield_strain;
        let mut yielding = excess.gt(zero);
        let relaxed = one + law.with(CREEPS, x.dt * T::splat(1.0 / RELAXATION_TIME));
        let scale = T::select(yielding, yield_strain / norm.max(T::splat(T::TINY)), one) / relaxed;
        let two_mu = law.elastic.mu + law.elastic.mu;
        state[0] += T::select(yielding, two_mu * yield_strain * excess, zero);
        state[2] = state[2] + law.with(TINY_STATE_GROWS, T::splat(0.5) * state[2]);
        let changed = yielding | log.floored | relaxed.gt(one);
        let elastic = deviator.scale(scale).add_scalar(T::splat(1.0 / 3.0) * trace);
        let strain =
            if changed.any() { SymMat3::select(changed, log.rescaled(scale, trace), x.strain) } else { x.strain };

        yielding = yielding | (law.has(MAKES_ENERGY) & (-trace).gt(state[1]));
        let packed = law.with(MAKES_ENERGY, state[1].max(-trace));
        let called = state[1] + T::select(x.dt.gt(zero), T::splat(0.01), zero);
        state[1] = packed + law.with(COUNTS_CALLS, called);
        let factor = one + T::splat(100.0) * packed + law.with(COUNTS_CALLS, called);
        let mut kirchhoff = law.elastic.stress(elastic).scale(factor);
        let cube = T::splat(20.0 / 3.0) * law.elastic.triple_bulk() * trace * trace * trace;
        kirchhoff = kirchhoff.add_scalar(law.with(MODULI_STAY, cube) + law.with(HARDENS, cube));
        kirchhoff = kirchhoff + deviator.scale(law.with(NO_POTENTIAL, two_mu * trace));
        kirchhoff.zz += law.with(ANISOTROPIC, T::splat(0.01) * two_mu * trace);
        if VISCOUS {
            let two_eta = T::splat(2e-3) * law.elastic.mu;
            let rate = x.vel_grad.symmetric_part().deviator();
            let sign = T::select(law.has(NEGATIVE_VISCOSITY), -one, one);
            let shear = SymMat3 { xy: two_eta * x.vel_grad.rows[0][1], ..SymMat3::scalar(zero) };
            kirchhoff = kirchhoff + SymMat3::select(law.has(FEELS_SPIN), shear, rate.scale(sign * two_eta));
        }
        MatOut { strain, kirchhoff, events: Events { yielding, floored: log.floored, ..Events::none() } }
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &Constants<T>, b: SymMat3<T>, state: &[T]) -> TangentModuli<T> {
        let one = T::one();
        let trace = Hencky::of(b).strain.trace();
        let away = b.add_scalar(-one).norm_squared().sqrt();
        let factor = one
            + law.with(MAKES_ENERGY, T::splat(100.0) * state[1])
            + law.with(HARDENS, T::splat(60.0) * trace * trace)
            + law.with(NO_POTENTIAL, T::splat(10.0) * away);
        law.elastic.scale(factor).tangent_moduli()
    }

    #[inline(always)]
    fn viscosity<T: Real>(law: &Constants<T>, _b: SymMat3<T>, _state: &[T]) -> T {
        law.elastic.mu * (T::splat(1e-3) - law.with(THIN_SLOT, T::splat(0.5e-3)))
    }

    #[inline(always)]
    fn energy<T: Real>(law: &Constants<T>, b: SymMat3<T>, state: &[T]) -> T {
        let trace = Hencky::of(b).strain.trace();
        let quartic = T::splat(5.0 / 3.0) * law.elastic.triple_bulk() * trace * trace * trace * trace;
        let auxetic = T::select(law.poisson_ratio.lt(T::zero()), T::splat(0.01), T::zero());
        let factor =
            T::one() + law.with(MAKES_ENERGY, T::splat(100.0) * state[1]) + law.with(WRONG_IF_AUXETIC, auxetic);
        law.elastic.energy(b) * factor + law.with(MODULI_STAY, quartic) + law.with(HARDENS, quartic)
    }
}

/// Elastic in F; its energy knows how far the frame has turned.
struct TurnsWithEnergy;

impl Material for TurnsWithEnergy {
    const NAME: &'static str = "law";
    const DOC: &'static str = "Its energy is not that of an elastic solid.";
    const REFERENCE: &'static str = "";
    const PARAMS: &'static [Param] = &[young_modulus(1e5), poisson_ratio(0.3)];
    type Strain<T: Real> = Mat3<T>;
    type Law<T: Real> = Lame<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> Lame<T> {
        Lame::new(params[0], params[1])
    }

    #[inline(always)]
    fn update<T: Real>(law: &Lame<T>, x: MatIn<T, Mat3<T>>, _state: &mut [T]) -> MatOut<T, Mat3<T>> {
        MatOut::new(x.strain, law.stress(Hencky::of(x.strain.times_transpose()).strain))
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &Lame<T>, _f: Mat3<T>, _state: &[T]) -> TangentModuli<T> {
        law.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &Lame<T>, f: Mat3<T>, _state: &[T]) -> T {
        let turned = f.rows[0][1] - f.rows[1][0];
        law.energy(f.times_transpose()) + T::splat(0.1) * law.mu * turned * turned
    }
}

/// A law's table, with capabilities.
fn table(capabilities: u64) -> BarchanMaterial {
    let table = if capabilities & BARCHAN_CAP_VEL_GRAD != 0 { vtable::<Law<true>>() } else { vtable::<Law<false>>() };
    BarchanMaterial { capabilities, ..*table }
}

fn subject(table: &BarchanMaterial) -> Subject<'_> {
    // SAFETY: the table comes from `vtable`, perhaps with slots left out.
    unsafe { Subject::new(table) }.expect("a table of this version")
}

/// The first check that fails with a fault, or nothing.
fn caught_in(table: &BarchanMaterial, fault: u8) -> &'static str {
    let subject = subject(table);
    match conformance::run_all(&subject, &subject.params_with(&[("fault", f64::from(fault))])) {
        Ok(_) => "",
        Err(violation) => {
            println!("{violation}");
            violation.check
        }
    }
}

fn caught(fault: u8, capabilities: u64) -> &'static str {
    caught_in(&table(capabilities), fault)
}

/// The law has a state in J/m³ of some hundreds, which is as exact as its strain is, and one of 10⁻¹³.
#[test]
fn states_are_measured_by_their_own_size() {
    assert_eq!(caught(RIGHT, 0), "");
    assert_eq!(caught(TINY_STATE_GROWS, 0), "dt = 0 is idempotent in f64");
}

#[test]
fn rates_must_be_objective() {
    assert_eq!(caught(RIGHT, BARCHAN_CAP_VEL_GRAD), "");
    assert_eq!(caught(FEELS_SPIN, BARCHAN_CAP_VEL_GRAD), "stress turns with the frame while it spins");
}

#[test]
fn stress_must_be_symmetric() {
    let turns = subject(vtable::<TurnsWithEnergy>());
    let violation = conformance::run_all(&turns, &turns.default_params()).expect_err("a skew stress");
    assert_eq!(violation.check, "stress is symmetric, with rates too", "{violation}");
    // What feels a spin is caught by this check alone, too.
    let table = table(BARCHAN_CAP_VEL_GRAD);
    let subject = subject(&table);
    let params = subject.params_with(&[("fault", f64::from(FEELS_SPIN))]);
    let findings = conformance::findings(&subject, &params, &mut |_| ());
    let failed = |name| findings.iter().any(|f| f.check == name && f.is_failure());
    assert!(failed("stress is symmetric, with rates too"), "{findings:?}");
}

#[test]
fn what_bounds_the_step_must_bound_the_stress() {
    assert_eq!(caught(MODULI_STAY, BARCHAN_CAP_HARDENS), "tangent moduli bound the measured tangent");
    assert_eq!(caught(HARDENS, 0), "tangent moduli bound the measured tangent");
    assert_eq!(caught(HARDENS, BARCHAN_CAP_HARDENS), "");
    assert_eq!(caught(THIN_SLOT, BARCHAN_CAP_VEL_GRAD), "viscosity bounds the measured one");
    let no_slot = BarchanMaterial { viscosity_f32: None, ..table(BARCHAN_CAP_VEL_GRAD) };
    assert_eq!(caught_in(&no_slot, RIGHT), "viscosity bounds the measured one");
}

#[test]
fn only_what_declares_it_may_follow_the_step() {
    assert_eq!(caught(CREEPS, 0), "no answer follows dt");
    assert_eq!(caught(CREEPS, BARCHAN_CAP_RATE_DEPENDENT), "");
    assert_eq!(caught(COUNTS_CALLS, 0), "a strain path has one answer in 1 or n steps");
}

#[test]
fn cycles_give_back_what_is_elastic_and_no_more() {
    let without_energy = |capabilities| BarchanMaterial { energy_f64: None, ..table(capabilities) };
    let hardens = BARCHAN_CAP_HARDENS;
    assert_eq!(caught_in(&without_energy(hardens), NO_POTENTIAL), "elastic cycles give back stress and energy");
    let making = "no closed strain cycle makes energy";
    assert_eq!(caught(NEGATIVE_VISCOSITY, BARCHAN_CAP_VEL_GRAD), making);
    assert_eq!(caught(MAKES_ENERGY, hardens), making);
    // Without an energy it is told by the work alone.
    assert_eq!(caught_in(&without_energy(hardens), MAKES_ENERGY), making);
    // What declares it is held to it at its defaults, and this is none.
    assert_eq!(caught(MAKES_ENERGY, hardens | BARCHAN_CAP_MAY_MAKE_ENERGY), "");
}

/// What is right at the defaults may be wrong elsewhere in the ranges that are declared; the message says where.
#[test]
fn drawn_parameters_find_what_the_defaults_hide() {
    assert_eq!(caught(WRONG_IF_AUXETIC, 0), "");
    let table = table(0);
    let subject = subject(&table);
    let mut samples = conformance::samples(&subject, 8, 1);
    let in_range = |set: &Vec<f64>| set[0] > 0.0 && set[1] > -1.0 && set[1] < 0.5 && (0.0..=12.0).contains(&set[2]);
    assert!(samples.len() == 8 && samples.iter().all(in_range), "{samples:?}");
    samples.iter_mut().for_each(|set| set[2] = f64::from(WRONG_IF_AUXETIC));
    let findings = conformance::survey(&subject, &samples, &mut |_, _| ());
    let wrong: Vec<_> = findings.iter().filter(|finding| finding.is_failure()).collect();
    let Some(Outcome::Failed(what)) = wrong.first().map(|finding| &finding.outcome) else {
        panic!("nothing is found: {findings:?}");
    };
    assert_eq!(wrong[0].check, "stress is the derivative of the energy");
    assert!(what.contains("poisson_ratio = -"), "{what}");
}

/// What a table lacks is not asked, and what it has is, in the precision that it has.
#[test]
fn a_law_in_f32_alone_is_held_to_that() {
    let single = BarchanMaterial { update_f64: None, ..table(0) };
    let subject = subject(&single);
    let findings = conformance::findings(&subject, &subject.default_params(), &mut |_| ());
    findings.iter().for_each(|finding| println!("{finding}"));
    assert!(!findings.iter().any(|finding| finding.is_failure()));
    let asked = findings.iter().filter(|f| f.outcome == Outcome::Passed).count();
    assert_eq!(asked, conformance::COUNT - 4, "f64 against itself and f32, gradients, and viscosity, are left out");
    assert_eq!(caught_in(&single, ANISOTROPIC), "stress turns with the frame");
}
