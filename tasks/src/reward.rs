//! Rewards: R = −α L + β over an episode, as UBSoft (CoRL 2024) has it; its constants were never published.

/// α and β of a task.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scale {
    /// Reward for a loss of 1.
    pub(crate) alpha: f64,
    /// Reward of an episode without any loss.
    pub(crate) beta: f64,
}

impl Scale {
    /// Reward of a control step: over an episode of `horizon` steps they add up to −α L + β.
    pub(crate) fn reward(&self, loss: f64, horizon: u64) -> f64 {
        -self.alpha * loss + self.beta / horizon as f64
    }

    /// Reward of the control steps that an episode which has failed does not take any more, with their losses.
    pub(crate) fn rest(&self, losses: impl Iterator<Item = f64>, horizon: u64) -> f64 {
        losses.map(|loss| self.reward(loss, horizon)).sum()
    }
}
