//! Corrections of joints' targets by how the base leans.

use super::Robot;
use super::joints::Order;
use super::model::RobotModel;
use crate::Refusal;
use crate::tables::Row;
use barchan_core::scene::{Balance, Lean, fits};
use glam::{DMat3, DVec3};

/// A correction of one joint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Correction {
    drive: usize,
    of: Lean,
    gain: f64,
    rate: f64,
}

/// The corrections that a scene's entries make, joint by joint.
///
/// # Errors
/// If an entry's pattern fits no joint.
pub(super) fn corrections(entries: &[Balance], model: &RobotModel) -> Result<Vec<Correction>, Refusal> {
    let mut all = Vec::new();
    for &Balance { ref joints, of, gain, rate } in entries {
        let before = all.len();
        let named = (0..model.drives.len()).filter(|&drive| fits(joints, &model.drives[drive].name));
        all.extend(named.map(|drive| Correction { drive, of, gain, rate }));
        if all.len() == before {
            let known: Vec<&str> = model.drives.iter().map(|drive| drive.name.as_str()).collect();
            let what = format!("no joint that moves fits the balance's '{joints}'");
            return Err(Refusal::new(what, format!("known are: {}", known.join(", "))));
        }
    }
    Ok(all)
}

impl Correction {
    /// As `robot/joints.wgsl` reads it, if drives' rates begin at `first` in the group.
    pub(super) fn table(&self, first: usize) -> Row {
        let of = match self.of {
            Lean::Pitch => 0.0,
            Lean::Roll => 1.0,
        };
        [(first + self.drive) as f32, of, self.gain as f32, self.rate as f32]
    }
}

/// How far the base leans [rad], and how fast [rad/s].
#[derive(Clone, Copy, Debug)]
pub(super) struct Leaning {
    pitch: [f64; 2],
    roll: [f64; 2],
}

impl Robot {
    /// Does balance correct what a motor is told?
    pub(super) fn corrects(&self, drive: usize) -> bool {
        self.corrections.iter().any(|correction| correction.drive == drive)
    }

    /// How the base leans now, if anything corrects that.
    pub(super) fn leaning(&self) -> Option<Leaning> {
        if self.corrections.is_empty() {
            return None;
        }
        let turn = DMat3::from_quat(self.state.base.rotation);
        // The world's upward axis, seen from the base: turned about y by the pitch, then about x by the roll.
        let up = turn.transpose() * DVec3::Z;
        let spin = turn.transpose() * self.twist(0).angular;
        Some(Leaning { pitch: [(-up.x).atan2(up.y.hypot(up.z)), spin.y], roll: [up.y.atan2(up.z), spin.x] })
    }

    /// Corrects what motors that hold a position are told, where the base leans so.
    pub(super) fn balance_orders(&self, leaning: Option<Leaning>, orders: &mut [Order]) {
        let Some(leaning) = leaning else { return };
        for &Correction { drive, of, gain, rate } in &self.corrections {
            let [angle, speed] = match of {
                Lean::Pitch => leaning.pitch,
                Lean::Roll => leaning.roll,
            };
            let order = &mut orders[drive];
            if order.holds {
                let [least, most] = self.model.drives[drive].limits;
                order.target = (order.target + gain * angle + rate * speed).clamp(least, most);
            }
        }
    }
}
