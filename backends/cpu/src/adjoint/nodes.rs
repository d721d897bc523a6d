//! Nodes of a level, by the blocks that particles touch.

use crate::grid::KeyHasher;
use barchan_grid::block::{self, CELLS};
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hash, Hasher};

/// A block, quickly hashed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Block(pub(super) [i32; 3]);

impl Hash for Block {
    fn hash<H: Hasher>(&self, state: &mut H) {
        state.write_u64(self.0.iter().fold(0, |key, b| key << 21 ^ u64::from(*b as u32)));
    }
}

/// Something by blocks.
pub(super) type ByBlock<T> = HashMap<Block, T, BuildHasherDefault<KeyHasher>>;

/// What the nodes of some blocks hold: of each three numbers that belong to its directions, and one.
pub(super) type Values = Vec<[[f64; 4]; CELLS]>;

/// Nodes, block by block.
#[derive(Default)]
pub(super) struct Nodes {
    at: ByBlock<usize>,
    pub(super) keys: Vec<[i32; 3]>,
    pub(super) values: Values,
}

impl Nodes {
    /// Number of a block, which is made if there is none.
    pub(super) fn block(&mut self, key: [i32; 3]) -> usize {
        let Self { at, keys, values } = self;
        *at.entry(Block(key)).or_insert_with(|| {
            keys.push(key);
            values.push([[0.0; 4]; CELLS]);
            keys.len() - 1
        })
    }

    /// A node by its number.
    #[inline(always)]
    pub(super) fn get(&self, node: usize) -> [f64; 4] {
        self.values[node / CELLS][node % CELLS]
    }

    #[inline(always)]
    pub(super) fn get_mut(&mut self, node: usize) -> &mut [f64; 4] {
        &mut self.values[node / CELLS][node % CELLS]
    }

    /// The number of the node in a cell, if its block is there.
    pub(super) fn find(&self, cell: [i32; 3]) -> Option<usize> {
        Some(self.at.get(&Block(block::of_cell(cell)))? * CELLS + block::place(cell))
    }

    /// The cell of the node with a number.
    pub(super) fn cell(&self, node: usize) -> [i32; 3] {
        let n = node % CELLS;
        let within = [n / 16, n / 4 % 4, n % 4];
        std::array::from_fn(|d| self.keys[node / CELLS][d] * block::SIDE + within[d] as i32)
    }

    /// Adds what nodes of some blocks hold.
    pub(super) fn add(&mut self, keys: &[[i32; 3]], values: &Values) {
        for (key, values) in keys.iter().zip(values) {
            let b = self.block(*key);
            let sums = self.values[b].as_flattened_mut().iter_mut();
            sums.zip(values.as_flattened()).for_each(|(sum, value)| *sum += value);
        }
    }

    /// The same nodes, each with what is made of it.
    pub(super) fn map(&self, of: impl Fn([f64; 4]) -> [f64; 4] + Sync) -> Self {
        let values = self.values.par_iter().map(|block| block.map(&of)).collect();
        Self { at: self.at.clone(), keys: self.keys.clone(), values }
    }

    /// The numbers that blocks of some pieces have among all.
    pub(super) fn numbers_of(&self, pieces: &Self) -> Vec<usize> {
        pieces.keys.iter().map(|key| self.at[&Block(*key)]).collect()
    }
}
