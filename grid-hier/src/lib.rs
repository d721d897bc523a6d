//! The grid of Barchan: B-spline weights, blocks, walls, and the transfers between particles and nodes.
//!
//! Nodes sit at cell centres, x_i = (i + 1/2) h, so that the knots of quadratic B-splines lie on cell faces and the spline
//! spaces of successive levels nest. A particle in cell c therefore touches nodes c - 1, c and c + 1 on each axis.
//!
//! Work is cut into blocks of 4 x 4 x 4 cells. A block's particles scatter into a [`block::Tile`]: the block's nodes
//! and a halo of two. The grid update sums tiles into nodes. No two blocks write the same memory, so there are no
//! atomics, and sums run in an order that does not depend on the number of threads.
#![expect(unsafe_code, reason = "the transfers work on raw planes of particles, in vector registers")]

pub mod adapt;
pub mod archive;
pub mod block;
pub mod bounds;
pub mod due;
pub mod limits;
pub mod near;
pub mod particles;
pub mod resample;
pub mod rest;
pub mod ring;
pub mod spline;
pub mod transfer;
pub mod wall;
pub mod wgsl;
