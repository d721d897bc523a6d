//! Barchan's elastic materials: [`NeoHookean`], [`FixedCorotated`], [`HenckyElastic`].

mod fixed_corotated;
mod hencky;
mod neo_hookean;

pub use fixed_corotated::FixedCorotated;
pub use hencky::HenckyElastic;
pub use neo_hookean::NeoHookean;

use barchan_material_kit::{BarchanMaterial, vtable};

/// The tables of this crate's materials.
pub fn materials() -> Vec<&'static BarchanMaterial> {
    vec![vtable::<NeoHookean>(), vtable::<FixedCorotated>(), vtable::<HenckyElastic>()]
}
