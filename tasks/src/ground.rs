//! The ground that robots walk on: sand, snow, or elastic.
//!
//! # Source
//! UBSoft (CoRL 2024), "Locomotion Task Results on More Materials", names the three; it gives constants of sand only.

use crate::base::{Size, check_own};
use barchan_core::parameter::{Parameter, Parameters};
use barchan_core::registry::TaskSetup;
use barchan_core::task::Limits;
use barchan_core::{Result, Scene};

/// The material of the scenes that it is.
const MATERIAL: &str = "ground";

/// What it may be.
const CHOICES: [&str; 3] = ["sand", "snow", "elastic"];

/// The parameter that says what it is, for a task's list.
pub(crate) fn parameter() -> Parameter {
    let doc = "What the ground is made of: dry sand, fresh snow, or an elastic solid.";
    Parameter::text("ground", &CHOICES, doc).or("sand")
}

/// Is it elastic?
pub(crate) fn is_elastic(parameters: &Parameters) -> bool {
    parameters.text("ground") == CHOICES[2]
}

/// Is it sand?
pub(crate) fn is_sand(parameters: &Parameters) -> bool {
    parameters.text("ground") == CHOICES[0]
}

/// What is changed in a scene's file.
///
/// Sand of the small size is five times as soft, which allows steps twice as long. Snow is that of Stomakhin et al. 2013; in the small size packed snow grows no
/// stiffer than four times, since steps would be too short. The elastic ground is as soft as
/// the softest on which the humanoid's ankles hold it (its m g h is 232 N m/rad).
///
/// # Errors
/// If other ground than sand is asked for in a scene that was given.
pub(crate) fn changes(setup: &TaskSetup<'_>, size: Size) -> Result<[String; 3]> {
    let ground = setup.parameters.text("ground");
    if ground != CHOICES[0] {
        check_own(setup, "ground", "the ground is what its materials say")?;
    }
    let (law, density, numbers) = match ground {
        "snow" => {
            let hardest = size.of(55.0, 4.0);
            let numbers = format!("young_modulus = 1.4e5, poisson_ratio = 0.2, hardening_max = {hardest:.1}");
            ("snow", 400.0, numbers)
        }
        "elastic" => ("fixed_corotated", 1000.0, "young_modulus = 2e5, poisson_ratio = 0.3".to_owned()),
        _ => {
            let young = size.of(1e6, 2e5);
            let numbers = format!("young_modulus = {young:.1}, poisson_ratio = 0.2, friction_angle_deg = 40.0");
            ("sand", 1600.0, numbers)
        }
    };
    Ok([
        format!("material.{MATERIAL}.law={law}"),
        format!("material.{MATERIAL}.density={density}"),
        format!("material.{MATERIAL}.parameters={{ {numbers} }}"),
    ])
}

/// Between what a seed changes its stiffness.
pub(crate) fn stiffness() -> Limits {
    Limits { name: "stiffness of the ground, a factor".to_owned(), low: 0.75, high: 1.25 }
}

/// Makes it stiffer by a factor.
pub(crate) fn stiffen(scene: &mut Scene, factor: f64) {
    let ground = scene.material.iter_mut().find(|material| material.name == MATERIAL);
    if let Some(young) = ground.and_then(|ground| ground.parameters.get_mut("young_modulus")) {
        *young *= factor;
    }
}
