//! What the interface asks of a table: declarations, a stress-free rest, each particle on its own, dt = 0, both precisions, faults reported.

use super::setting::{Setting, distance, short, stress};
use super::{Checked, Worst, not_asked, sound};
use crate::subject::{Answer, Particle, Precision};
use barchan_abi::*;
use core::ptr::{null, null_mut};

pub(super) const ONLY_F32: &str = "it has no update_f64";

impl From<Worst> for super::Answered {
    fn from(worst: Worst) -> Self {
        Self::Worst(worst)
    }
}

pub(super) fn declarations(s: &Setting<'_>) -> Checked {
    let table = s.subject.table();
    if s.subject.name().is_empty() {
        return Err("the name is empty".into());
    }
    if table.strain_kind != BARCHAN_STRAIN_DEF_GRAD && table.strain_kind != BARCHAN_STRAIN_LEFT_CAUCHY_GREEN {
        return Err(format!("strain_kind is {}", table.strain_kind));
    }
    let mut names = Vec::new();
    for p in s.subject.params() {
        let name = s.subject.text(p.name);
        let value = p.default_value;
        let below = value < p.min_value || (value <= p.min_value && p.flags & BARCHAN_PARAM_MIN_OPEN != 0);
        let above = value > p.max_value || (value >= p.max_value && p.flags & BARCHAN_PARAM_MAX_OPEN != 0);
        if below || above || value.is_nan() {
            return Err(format!("the default {value} of '{name}' is outside {} .. {}", p.min_value, p.max_value));
        }
        names.push(name);
    }
    for q in s.subject.states() {
        let name = s.subject.text(q.name);
        if !q.initial_value.is_finite() || q.merge > BARCHAN_MERGE_REFUSE {
            return Err(format!("state '{name}' starts at {} with merge rule {}", q.initial_value, q.merge));
        }
        names.push(name);
    }
    for name in &names {
        let snake = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if name.is_empty() || !name.chars().all(snake) {
            return Err(format!("'{name}' is not in snake_case"));
        }
        if names.iter().filter(|other| *other == name).count() > 1 {
            return Err(format!("'{name}' is declared twice"));
        }
    }
    s.subject.check_params(s.params).map_err(|e| format!("check_params refuses the parameters: {e}"))?;
    sound()
}

pub(super) fn zero_stress_at_identity(s: &Setting<'_>) -> Checked {
    let modulus = s.modulus()?;
    let mut worst = Worst::default();
    for &precision in s.precisions() {
        let answer = s.update(precision, &[s.subject.particle_at_rest()])?[0];
        worst.see(distance(&answer.kirchhoff, &[0.0; 6]) / modulus, || {
            format!(": {precision:?}, stress {}", stress(&answer.kirchhoff))
        });
    }
    Ok(worst.into())
}

pub(super) fn batch_independence(s: &Setting<'_>) -> Checked {
    let particles = s.particles();
    let n = particles.len();
    for &precision in s.precisions() {
        let update = |particles: &[Particle], stride: usize| {
            s.subject
                .update_strided(precision, s.params, 1e-4, particles, stride)
                .map_err(|e| format!("{precision:?} update: {e}"))
        };
        let alone: Vec<Answer> = particles.iter().map(|&p| Ok(update(&[p], 1)?[0])).collect::<Result<_, String>>()?;
        // Other neighbours, other lanes, other batch sizes, strides that are and are not multiples of 16.
        for (shift, count, stride) in [(0, n, n), (5, n, n + 13), (16, 16, 16), (3, 20, 64), (11, 15, 16)] {
            let order: Vec<usize> = (0..count).map(|i| (i * 7 + shift) % n).collect();
            let batch: Vec<Particle> = order.iter().map(|&i| particles[i]).collect();
            for (lane, (answer, &i)) in update(&batch, stride)?.iter().zip(&order).enumerate() {
                let bits = |a: &Answer| {
                    let all = a.strain.iter().chain(&a.kirchhoff).chain(&a.state);
                    all.map(|x| x.to_bits()).collect::<Vec<u64>>()
                };
                if bits(answer) != bits(&alone[i]) {
                    return Err(format!(
                        "{precision:?}: particle {lane} of {count} gets {answer:?}, alone it gets {:?}",
                        alone[i]
                    ));
                }
            }
        }
    }
    sound()
}

pub(super) fn idempotence(s: &Setting<'_>, precision: Precision) -> Checked {
    if !s.precisions().contains(&precision) {
        return not_asked(ONLY_F32);
    }
    let particles = s.particles();
    let first = s.update(precision, &particles)?;
    let scales = s.scales_at(&first)?;
    let again: Vec<Particle> = particles
        .iter()
        .zip(&first)
        .map(|(p, a)| Particle { strain: a.strain, state: a.state, vel_grad: p.vel_grad })
        .collect();
    let second = s.update(precision, &again)?;
    let mut worst = Worst::default();
    for (((a, b), p), scales) in first.iter().zip(&second).zip(&particles).zip(scales) {
        worst.see(scales.difference(a, b), || {
            let strain = short(&p.strain[..s.subject.strain_planes()]);
            format!(": strain {strain} gives {}, and that gives {}", what(s, a), what(s, b))
        });
    }
    Ok(worst.into())
}

/// An answer for people.
pub(super) fn what(s: &Setting<'_>, a: &Answer) -> String {
    let strain = short(&a.strain[..s.subject.strain_planes()]);
    let states = &a.state[..s.subject.table().n_state];
    let state = if states.is_empty() { String::new() } else { format!(", state {states:?}") };
    format!("strain {strain}, stress {}{state}", stress(&a.kirchhoff))
}

pub(super) fn precisions_agree(s: &Setting<'_>) -> Checked {
    if s.best == Precision::F32 {
        return not_asked(ONLY_F32);
    }
    let mut particles = Vec::new();
    for (seed, size) in [(12, 1e-4), (13, 1e-3), (14, 1e-2)] {
        particles.extend(s.deformations(seed, 30, 1.0 - size, size).into_iter().map(|f| s.particle(f)));
    }
    // Both see the same input, so that only the arithmetic differs.
    for particle in &mut particles {
        particle.strain = particle.strain.map(|x| f64::from(x as f32));
    }
    let (single, double) = (s.update(Precision::F32, &particles)?, s.update(Precision::F64, &particles)?);
    let mut worst = Worst::default();
    for ((a, b), scales) in double.iter().zip(&single).zip(s.scales_at(&double)?) {
        worst.see(scales.difference(a, b), || format!(": f64 gives {}, f32 {}", what(s, a), what(s, b)));
    }
    Ok(worst.into())
}

pub(super) fn non_finite_is_reported(s: &Setting<'_>) -> Checked {
    let places = s.subject.strain_planes() + s.subject.table().n_state;
    for &precision in s.precisions() {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for (count, victim) in [(1, 0), (40, 21), (40, 39), (64, 16)] {
                for place in 0..places {
                    let mut particles = vec![s.subject.particle_at_rest(); count];
                    match place.checked_sub(s.subject.strain_planes()) {
                        None => particles[victim].strain[place] = bad,
                        Some(state) => particles[victim].state[state] = bad,
                    }
                    let what = format!("{precision:?}: {bad} in plane {place} of particle {victim} of {count}");
                    match s.subject.update(precision, s.params, 1e-4, &particles) {
                        Ok(_) => return Err(format!("{what} is not reported")),
                        Err(e) if e.status != BARCHAN_E_NON_FINITE || e.particle != Some(victim as u64) => {
                            return Err(format!("{what} is reported as {e}"));
                        }
                        Err(_) => {}
                    }
                }
            }
        }
    }
    sound()
}

pub(super) fn bad_structs_are_refused(s: &Setting<'_>) -> Checked {
    let Some(single) = s.subject.table().update_f32 else { return Err("update_f32 is missing".into()) };
    let params: Vec<f32> = s.params.iter().map(|&p| p as f32).collect();
    let empty = BarchanBatchF32 {
        struct_size: size_of::<BarchanBatchF32>(),
        n: 0,
        stride: 0,
        dt: 0.0,
        reserved: 0,
        params: params.as_ptr(),
        strain_trial: null(),
        vel_grad: null(),
        state_in: null(),
        strain: null_mut(),
        kirchhoff: null_mut(),
        state_out: null_mut(),
    };
    let short = BarchanBatchF32 { struct_size: 8, ..empty };
    let without_planes = BarchanBatchF32 { n: 4, stride: 16, ..empty };
    // SAFETY: these are the cases that the ABI obliges a callback to refuse before it follows a pointer; NULL errors are
    // allowed.
    let statuses = unsafe {
        [
            ("a NULL batch (f32)", single(null(), null_mut())),
            ("a batch of 8 bytes (f32)", single(&short, null_mut())),
            ("a batch without planes (f32)", single(&without_planes, null_mut())),
        ]
    };
    // SAFETY: as above.
    let status = unsafe { single(&empty, null_mut()) };
    refused(&statuses, status)?;

    let Some(double) = s.subject.table().update_f64 else { return sound() };
    let empty = BarchanBatchF64 {
        struct_size: size_of::<BarchanBatchF64>(),
        n: 0,
        stride: 0,
        dt: 0.0,
        params: s.params.as_ptr(),
        strain_trial: null(),
        vel_grad: null(),
        state_in: null(),
        strain: null_mut(),
        kirchhoff: null_mut(),
        state_out: null_mut(),
    };
    let short = BarchanBatchF64 { struct_size: 8, ..empty };
    let without_planes = BarchanBatchF64 { n: 4, stride: 16, ..empty };
    // SAFETY: as above.
    let (statuses, status) = unsafe {
        (
            [
                ("a NULL batch (f64)", double(null(), null_mut())),
                ("a batch of 8 bytes (f64)", double(&short, null_mut())),
                ("a batch without planes (f64)", double(&without_planes, null_mut())),
            ],
            double(&empty, null_mut()),
        )
    };
    refused(&statuses, status)?;
    sound()
}

/// All of them must be refused, but not the batch of no particles.
fn refused(statuses: &[(&str, BarchanStatus)], empty: BarchanStatus) -> Result<(), String> {
    if let Some((what, _)) = statuses.iter().find(|(_, status)| *status == BARCHAN_OK) {
        return Err(format!("{what} is accepted"));
    }
    if empty != BARCHAN_OK {
        return Err(format!("a batch of no particles is refused with status {empty}"));
    }
    Ok(())
}
