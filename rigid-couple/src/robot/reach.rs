//! Inverse kinematics: joint positions that bring a link's frame to a place, by damped least squares within the joints' limits.

use super::dynamics::places;
use super::model::RobotModel;
use crate::Refusal;
use crate::motion::Pose;
use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};

/// Steps after which a target counts as out of reach, and what may be missing then [m, and rad times metres].
const MOST_STEPS: usize = 200;
const MISSING: f64 = 1e-5;
/// Damping [m], and the longest step towards the target [m or rad].
const DAMPING: f64 = 0.01;
const LONGEST: f64 = 0.05;
/// A radian that is missing counts as so many metres.
const RADIAN: f64 = 0.2;

/// Where a link is to be.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// The link's number.
    pub link: usize,
    /// Where its frame's origin is to be, in the world [m].
    pub position: DVec3,
    /// Its orientation, if that matters.
    pub rotation: Option<DQuat>,
}

/// Moves joint positions until all targets are reached, the base staying where it is.
///
/// # Errors
/// If they are not, with what is missing.
pub fn reach(model: &RobotModel, base: &Pose, targets: &[Target], positions: &mut [f64]) -> Result<(), Refusal> {
    let mut missing = Vec::new();
    for _ in 0..MOST_STEPS {
        let all = places(model, false, base, positions);
        let (mut errors, mut rows): (Vec<f64>, Vec<Vec<f64>>) = (Vec::new(), Vec::new());
        missing.clear();
        for target in targets {
            let place = &all[target.link];
            let arm = place.frame.position - place.centre;
            let off = target.position - place.frame.position;
            let turn = target.rotation.map(|rotation| {
                let by = rotation * place.frame.rotation.conjugate();
                RADIAN * if by.w < 0.0 { -by } else { by }.to_scaled_axis()
            });
            missing.push(off.length() + turn.map_or(0.0, DVec3::length));
            for d in 0..3 {
                let mut row = vec![0.0; positions.len()];
                place.columns.iter().for_each(|column| row[column.rate] = column.twist.at(arm)[d]);
                errors.push(off[d]);
                rows.push(row);
            }
            for d in (0..3).filter(|_| turn.is_some()) {
                let mut row = vec![0.0; positions.len()];
                place.columns.iter().for_each(|column| row[column.rate] = RADIAN * column.twist.angular[d]);
                errors.push(turn.map_or(0.0, |turn| turn[d]));
                rows.push(row);
            }
        }
        if missing.iter().all(|missing| *missing <= MISSING) {
            return Ok(());
        }
        let jacobian = DMatrix::from_fn(rows.len(), positions.len(), |i, j| rows[i][j]);
        let mut error = DVector::from_vec(errors);
        let size = error.amax();
        if size > LONGEST {
            error *= LONGEST / size;
        }
        let square = &jacobian * jacobian.transpose()
            + DMatrix::identity(rows.len(), rows.len()) * (DAMPING * DAMPING * size.min(1.0));
        let Some(solved) = square.cholesky() else { break };
        let step = jacobian.transpose() * solved.solve(&error);
        for ((position, change), drive) in positions.iter_mut().zip(step.iter()).zip(&model.drives) {
            *position = (*position + change.clamp(-0.5, 0.5)).clamp(drive.limits[0], drive.limits[1]);
        }
    }
    let (worst, target) = missing.iter().zip(targets).max_by(|a, b| a.0.total_cmp(b.0)).unwrap_or((&0.0, &targets[0]));
    let name = &model.links[target.link].name;
    let at = target.position;
    Err(Refusal::new(
        format!(
            "link '{name}' cannot reach ({:.3}, {:.3}, {:.3}) m within its joints' limits: {:.1} mm are missing",
            at.x,
            at.y,
            at.z,
            1e3 * worst
        ),
        "give a nearer place, or start from joint positions nearer to it",
    ))
}
