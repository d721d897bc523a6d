//! Sums over particles on the host: for the ledger, and to find what is not finite.

use barchan_abi as abi;
use barchan_core::material::ErrorBuffer;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Error, Ledger, ParticleList, Scene};

/// Particles handed to a material at a time.
pub(crate) const BATCH: usize = 64;

/// Adds mass, momenta, energies and the materials' counts.
pub(crate) fn add_particles(ledger: &mut Ledger, lists: &[ParticleList], materials: &[PlannedMaterial], scene: &Scene) {
    for list in lists {
        let quarter = 0.25 * list.cell_width * list.cell_width;
        for i in 0..list.len() {
            let (m, v, c, x) = (list.mass[i], list.velocity[i], list.affine[i], list.position(i));
            ledger.particles += 1;
            ledger.mass += m;
            for d in 0..3 {
                let (a, b) = ((d + 1) % 3, (d + 2) % 3);
                ledger.momentum[d] += m * v[d];
                // x × v, and the spin that C carries about the particle.
                ledger.angular_momentum[d] += m * (x[a] * v[b] - x[b] * v[a] + quarter * (c[3 * b + a] - c[3 * a + b]));
                ledger.potential -= m * scene.gravity[d] * x[d];
            }
            let square = |values: &[f64]| values.iter().map(|y| y * y).sum::<f64>();
            ledger.kinetic += 0.5 * m * (square(&v) + quarter * square(&c));
        }
        add_material(ledger, list, &materials[list.material as usize]);
    }
}

/// Adds elastic energy and the counts of one list.
pub(crate) fn add_material(ledger: &mut Ledger, list: &ParticleList, planned: &PlannedMaterial) {
    let table = &planned.material.table;
    if table.energy_f64.is_none() {
        ledger.elastic = f64::NAN;
    }
    let mut strain = vec![[0f64; BATCH]; list.strain.len()];
    let mut state = vec![[0f64; BATCH]; list.state.len()];
    let mut energy = [0f64; BATCH];
    let no_rate = [[0f64; BATCH]; 9];
    let wants_rate = planned.material.has(abi::BARCHAN_CAP_VEL_GRAD);
    let mut counts = [0u64; abi::BARCHAN_N_COUNTERS];
    for from in (0..list.len()).step_by(BATCH) {
        let n = (list.len() - from).min(BATCH);
        let planes = list.strain.iter().zip(&mut strain).chain(list.state.iter().zip(&mut state));
        planes.for_each(|(plane, batch)| batch[..n].copy_from_slice(&plane[from..from + n]));
        let batch = abi::BarchanBatchF64 {
            struct_size: size_of::<abi::BarchanBatchF64>(),
            n,
            stride: BATCH,
            dt: 0.0,
            params: planned.parameters.as_ptr(),
            strain_trial: strain.as_ptr().cast(),
            vel_grad: if wants_rate { no_rate.as_ptr().cast() } else { std::ptr::null() },
            state_in: if state.is_empty() { std::ptr::null() } else { state.as_ptr().cast() },
            strain: std::ptr::null_mut(),
            kirchhoff: std::ptr::null_mut(),
            state_out: std::ptr::null_mut(),
        };
        let mut message = ErrorBuffer::default();
        if let Some(callback) = table.energy_f64 {
            // SAFETY: the planes that this callback reads are BATCH long and n <= BATCH.
            let status = unsafe { callback(&batch, energy.as_mut_ptr(), message.as_raw()) };
            for (e, volume) in energy[..n].iter().zip(&list.volume0[from..]) {
                ledger.elastic += if status == abi::BARCHAN_OK { e * volume } else { f64::NAN };
            }
        }
        if let Some(callback) = table.count_f64 {
            let mut here = [0u64; abi::BARCHAN_N_COUNTERS];
            // SAFETY: as above.
            if unsafe { callback(&batch, here.as_mut_ptr(), message.as_raw()) } == abi::BARCHAN_OK {
                counts.iter_mut().zip(here).for_each(|(sum, count)| *sum += count);
            }
        }
    }
    for (what, index) in [
        ("yielding", abi::BARCHAN_COUNT_YIELDING),
        ("stress-free at the apex", abi::BARCHAN_COUNT_APEX),
        ("with a floored stretch", abi::BARCHAN_COUNT_FLOORED),
        ("with a clamped state", abi::BARCHAN_COUNT_CLAMPED),
    ] {
        ledger.count(&format!("{} particles {what} now", planned.name), counts[index]);
    }
}

/// The particle of least id with a NaN or infinite value: field, id, list, value, and how many there are.
pub(crate) fn find_non_finite(
    lists: &[ParticleList],
    name: impl Fn(&'static str, u64, usize, f64, u64) -> Error,
) -> Option<Error> {
    let mut first: Option<(u64, &'static str, usize, f64)> = None;
    let mut count = 0;
    for (l, list) in lists.iter().enumerate() {
        for i in 0..list.len() {
            let velocity = list.velocity[i].iter().map(|&x| ("velocity", x));
            let affine = list.affine[i].iter().map(|&x| ("affine", x));
            let strain = list.strain.iter().map(|plane| ("strain", plane[i]));
            let history = list.state.iter().map(|plane| ("history", plane[i]));
            let rest = [("mass", list.mass[i]), ("volume0", list.volume0[i])];
            let mut fields = velocity.chain(affine).chain(rest).chain(strain).chain(history);
            if let Some((field, value)) = fields.find(|(_, x)| !x.is_finite()) {
                count += 1;
                if first.is_none_or(|f| list.id[i] < f.0) {
                    first = Some((list.id[i], field, l, value));
                }
            }
        }
    }
    first.map(|(id, field, l, value)| name(field, id, l, value, count))
}
