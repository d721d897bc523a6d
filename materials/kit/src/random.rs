//! Repeatable random tensors for tests.

use crate::tensor::{Mat3, SymMat3};

/// SplitMix64 (Steele, Lea and Flood 2014).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// A sequence that `seed` fixes.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [-1, 1).
    pub fn signed(&mut self) -> f64 {
        2.0 * self.unit() - 1.0
    }

    /// Entries uniform in [-1, 1).
    pub fn symmetric(&mut self) -> SymMat3<f64> {
        SymMat3::from_components([0; 6].map(|_| self.signed()))
    }

    /// Entries uniform in [-1, 1).
    pub fn matrix(&mut self) -> Mat3<f64> {
        Mat3::from_components([0; 9].map(|_| self.signed()))
    }

    /// A rotation, uniformly distributed (from a random unit quaternion).
    pub fn rotation(&mut self) -> Mat3<f64> {
        let q = loop {
            let q = [0; 4].map(|_| self.signed());
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (0.1..1.0).contains(&norm) {
                break q.map(|x| x / norm);
            }
        };
        let [w, x, y, z] = q;
        Mat3 {
            rows: [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ],
        }
    }
}
