//! Sums over particles on the host: for the ledger, and to find what is not finite.

use barchan_core::account::{BATCH, MaterialSums, NonFinite, add_particle};
use barchan_core::batch::Plane;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Ledger, ParticleList, Scene};

/// Adds mass, momenta, energies and the materials' counts.
pub(crate) fn add_particles(ledger: &mut Ledger, lists: &[ParticleList], materials: &[PlannedMaterial], scene: &Scene) {
    for list in lists {
        for i in 0..list.len() {
            let motion = (&list.velocity[i][..], &list.affine[i][..]);
            add_particle(ledger, (list.mass[i], list.position(i)), motion, list.cell_width, scene.gravity);
        }
        add_material(ledger, list, &materials[list.material as usize]);
    }
}

/// Adds elastic energy and the counts of one list.
fn add_material(ledger: &mut Ledger, list: &ParticleList, planned: &PlannedMaterial) {
    let mut sums = MaterialSums::new(planned, ledger);
    for from in (0..list.len()).step_by(BATCH) {
        let n = (list.len() - from).min(BATCH);
        // The last particle stands in for those behind it, so that no material sees a strain that nothing can have.
        let fill = |plane: &Vec<f64>| Plane(std::array::from_fn(|i| plane[from + i.min(n - 1)]));
        let strain: Vec<_> = list.strain.iter().map(fill).collect();
        let state: Vec<_> = list.state.iter().map(fill).collect();
        sums.add(ledger, &strain, &state, &list.volume0[from..from + n]);
    }
    sums.end(ledger);
}

/// Looks for NaN and infinity among the particles of some lists.
pub(crate) fn find_non_finite(lists: &[ParticleList]) -> NonFinite {
    let mut search = NonFinite::default();
    for list in lists {
        for i in 0..list.len() {
            let rest = [list.mass[i], list.volume0[i]].into_iter();
            let rest = rest.chain(list.strain.iter().chain(&list.state).map(|plane| plane[i]));
            let who = (list.id[i], list.material as usize);
            search.see(who, (&list.velocity[i], &list.affine[i]), rest, list.strain.len());
        }
    }
    search
}
