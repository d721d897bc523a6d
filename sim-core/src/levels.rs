//! Regions of nested levels, and how they follow agents.
//!
//! Level l has cells of width 2^l h. Its region is a union of boxes of whole parent cells, one around each agent. The
//! coarsest level covers the whole world. A particle belongs to the finest level whose region, grown by
//! [`SPLIT_AHEAD`], holds its cell when particles are sorted. Regions nest with a margin, so that no three levels meet.
//! They move by whole parent cells once an agent has left a dead zone about their middle.

use crate::coupling::Aabb;
use crate::scene::{Scene, Wall};
use crate::{BodyState, Coupling, LevelPhase, ParticleList, ParticleState, Vec3};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, HashMap};

/// Least number of parent cells between a region's faces and those of the next coarser region.
pub const NESTING: i32 = 4;
/// Distance that an agent may have from the middle of its boxes before they move, in parent cells.
pub const DEAD_ZONE: f64 = 2.0;
/// Cells of the finest level that the finest box holds on each side of an agent, so that contact is decided there.
pub const AROUND_AGENT: f64 = 4.0;
/// A particle closer than this to a region, in parent cells of that region, is on its level, and is split until it is
/// as fine. Fine particles outside their region see the coarser level's field through the rim. A coarse particle that
/// drifts into a finer region before the next sort, by a cell at most, would see nodes that only it has touched.
/// Without this margin a ball that spins through a rim gains 5e-4 of its angular momentum a turn, with it none.
pub const SPLIT_AHEAD: i32 = 1;
/// Particles merge when they are further than this from a finer region, in parent cells of that region.
pub const MERGE_BEHIND: i32 = 3;
/// The same of particles that a region leaves behind as it moves. Nearer ones would stay fine on a coarse level for long, and as a rule the region does not come
/// back. What drifts about a region that stays would merge and split in turns.
pub const MERGE_LEFT: i32 = 2;

/// Depth below the surface, in cells, that ground needs to bear and give way as deep ground does. The stencil of a node
/// is three cells wide, and one more cell must lie between the surface and the floor that neither of them reaches.
pub const LEAST_DEPTH: f64 = 4.0;
/// Cells of the coarsest level along a side of a tile. A tile is a column over the whole height of the world; ground
/// comes within reach and goes out of it by tiles.
pub const TILE: i32 = 4;

/// What becomes of levels and of their particles before a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Adapted {
    /// Boxes of each level but the coarsest in the step, in cells of the level.
    pub boxes: Vec<Vec<CellBox>>,
    /// Tiles that are live in the step, if only the ground within reach is.
    pub live: BTreeSet<[i32; 2]>,
    /// Which levels had their particles sorted.
    pub sorted: Vec<bool>,
    /// Was strain brought up to date before, where it [lags behind](ParticleState::strain_dt)?
    pub carried: bool,
    /// What particles went through, one after the other.
    pub changes: Vec<LevelChange>,
}

/// What a particle goes through where levels move, or it moves from level to level. Particles are named by their numbers.
#[derive(Clone, Debug, PartialEq)]
pub enum LevelChange {
    /// One becomes eight, of which the first keeps its number.
    Split {
        /// Which.
        id: u32,
        /// Its children, octant by octant, x fastest.
        children: [u32; 8],
        /// How far these are from its middle, where 1 is the middles of its octants.
        scale: f64,
    },
    /// Several become one, which has the least of their numbers.
    Merge {
        /// Which.
        members: Vec<u32>,
    },
    /// Some are on another level from now on, or new ones have found their own.
    Move {
        /// Which.
        ids: Vec<u32>,
        /// The level.
        to: u32,
    },
    /// One goes out of reach.
    Leave {
        /// Which.
        id: u32,
    },
    /// These come within reach, all of one level and material.
    Come(Box<ParticleList>),
}

/// A box of cells of one level, from `min` up to but without `max`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CellBox {
    /// First cell.
    pub min: [i32; 3],
    /// One past the last cell.
    pub max: [i32; 3],
}

impl CellBox {
    /// Whether the cell lies in the box.
    pub fn contains(&self, cell: [i32; 3]) -> bool {
        (0..3).all(|d| self.min[d] <= cell[d] && cell[d] < self.max[d])
    }
    /// Whether all of `other` lies in the box.
    pub fn holds(&self, other: &Self) -> bool {
        (0..3).all(|d| self.holds_along(other, d))
    }
    /// Whether `other` ends in the box along an axis.
    fn holds_along(&self, other: &Self, d: usize) -> bool {
        self.min[d] <= other.min[d] && other.max[d] <= self.max[d]
    }
    /// Whether the boxes have a cell in common.
    pub fn meets(&self, other: &Self) -> bool {
        (0..3).all(|d| self.min[d] < other.max[d] && other.min[d] < self.max[d])
    }
    /// With `by` more cells on every side.
    #[must_use]
    pub fn grown(&self, by: i32) -> Self {
        Self { min: self.min.map(|x| x - by), max: self.max.map(|x| x + by) }
    }
    /// The same box in parent cells, rounded outwards.
    fn in_parents(&self) -> Self {
        Self { min: self.min.map(|x| x >> 1), max: self.max.map(|x| (x + 1) >> 1) }
    }
    fn moved(&self, by: [i32; 3]) -> Self {
        Self { min: std::array::from_fn(|d| self.min[d] + by[d]), max: std::array::from_fn(|d| self.max[d] + by[d]) }
    }
}

/// How much of a box of cells lies in a region.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cover {
    /// All of it, within one of the region's boxes.
    All,
    /// Part of it, or all of it in several boxes.
    Part,
    /// Nothing.
    None,
}

/// How far an agent may move before any level has to: bounds on the ends of its box, and on their sum along each axis,
/// in cells of the finest level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Leeway {
    /// Bounds of the ends of the agent's box.
    pub ends: CellBox,
    /// Least and greatest sum of the two ends, along each axis.
    pub sums: [[i32; 3]; 2],
    /// Greatest lower end along each axis.
    pub least: [i32; 3],
}

impl Leeway {
    /// The leeway of an agent that has no place yet: no box fits.
    pub const fn none() -> Self {
        Self {
            ends: CellBox { min: [i32::MAX; 3], max: [i32::MIN; 3] },
            sums: [[i32::MIN; 3], [i32::MAX; 3]],
            least: [i32::MIN; 3],
        }
    }

    /// What both leave.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        let most = |a: [i32; 3], b: [i32; 3]| std::array::from_fn(|d| a[d].max(b[d]));
        let least = |a: [i32; 3], b: [i32; 3]| std::array::from_fn(|d| a[d].min(b[d]));
        Self {
            ends: CellBox { min: most(self.ends.min, other.ends.min), max: least(self.ends.max, other.ends.max) },
            sums: [most(self.sums[0], other.sums[0]), least(self.sums[1], other.sums[1])],
            least: least(self.least, other.least),
        }
    }

    /// Extended so that `known` fits: a box that is known to fit.
    #[must_use]
    pub fn with(self, known: CellBox) -> Self {
        let sum = |d: usize| known.min[d] + known.max[d];
        let ends = CellBox {
            min: std::array::from_fn(|d| self.ends.min[d].min(known.min[d])),
            max: std::array::from_fn(|d| self.ends.max[d].max(known.max[d])),
        };
        let sums = [
            std::array::from_fn(|d| self.sums[0][d].min(sum(d))),
            std::array::from_fn(|d| self.sums[1][d].max(sum(d))),
        ];
        Self { ends, sums, least: std::array::from_fn(|d| self.least[d].max(known.min[d])) }
    }
}

/// The regions of all levels but the coarsest.
#[derive(Clone, Debug, PartialEq)]
pub struct Regions {
    /// Width of the finest cell [m].
    h: f64,
    /// Coarsest cells around the boxes that are live; 0: the whole world is.
    reach: i32,
    /// The world in cells of the finest level.
    world: CellBox,
    /// Ends of each axis that have a wall: the region goes on behind it.
    walled: [[bool; 2]; 3],
    periodic: [bool; 3],
    /// Boxes of each level, one an agent, in cells of the level.
    boxes: Vec<Vec<CellBox>>,
}

impl Regions {
    /// Regions without boxes: every place is on the coarsest of `scene.levels.count` levels.
    pub fn new(scene: &Scene, world: CellBox) -> Self {
        let ends: [[Wall; 2]; 3] = std::array::from_fn(|d| scene.world.walls.pair(d));
        Self {
            h: scene.world.cell,
            reach: scene.levels.reach as i32,
            world,
            walled: ends.map(|axis| axis.map(|wall| wall.is_wall())),
            periodic: ends.map(|axis| axis[0] == Wall::Periodic),
            boxes: vec![Vec::new(); scene.levels.count as usize - 1],
        }
    }

    /// Number of levels.
    pub fn levels(&self) -> usize {
        self.boxes.len() + 1
    }

    /// Boxes of each level but the coarsest, in cells of the level.
    pub fn boxes(&self) -> &[Vec<CellBox>] {
        &self.boxes
    }

    /// Takes over the boxes of a saved run.
    pub fn restore(&mut self, boxes: Vec<Vec<CellBox>>) {
        self.boxes = boxes;
    }

    /// Checks the levels of a saved run: boxes must be of whole parent cells and nest, each agent's within its own, and
    /// live tiles must lie in the world. The error says what is wrong.
    pub fn check(&self, phase: &LevelPhase) -> Result<(), String> {
        if phase.boxes.len() != self.boxes.len() {
            return Err(format!("boxes of {} levels where the plan has {}", phase.boxes.len() + 1, self.levels()));
        }
        let farthest = crate::plan::FARTHEST_CELL as i32;
        let is_whole = |one: &CellBox| {
            let ends = || one.min.iter().chain(&one.max);
            (0..3).all(|d| one.min[d] < one.max[d]) && ends().all(|c| c % 2 == 0 && (-farthest..=farthest).contains(c))
        };
        for (level, boxes) in phase.boxes.iter().enumerate() {
            if let Some(one) = boxes.iter().find(|one| !is_whole(one)) {
                return Err(format!("a box of level {level} is {one:?}"));
            }
            let Some(finer) = level.checked_sub(1).map(|finer| &phase.boxes[finer]) else { continue };
            let nests = |(inner, outer): (&CellBox, &CellBox)| outer.holds(&inner.in_parents().grown(NESTING));
            if finer.len() != boxes.len() || !finer.iter().zip(boxes).all(nests) {
                return Err(format!("boxes of level {level} do not hold those of the next finer one"));
            }
        }
        match phase.live.iter().find(|tile| !self.is_tile_of_world(**tile)) {
            Some(tile) => Err(format!("tile {tile:?} is live and lies outside the world")),
            None => Ok(()),
        }
    }

    /// Moves the boxes after their agents, each along the axes on which it has to. Returns whether any has moved.
    pub fn follow(&mut self, targets: &[Target]) -> bool {
        let mut moved = false;
        for level in 0..self.boxes.len() {
            let parent = self.h * f64::from(1 << (level + 1));
            let kept = std::mem::take(&mut self.boxes[level]);
            let mut boxes = Vec::with_capacity(targets.len());
            for (a, target) in targets.iter().enumerate() {
                let inner = level.checked_sub(1).map(|finer| self.boxes[finer][a].in_parents().grown(NESTING));
                let around = target.bounds.grown(AROUND_AGENT * self.h);
                let mut chosen = ideal(&around, target.half, inner, parent);
                if let Some(old) = kept.get(a) {
                    // A foot that swings forward would else take its box along in height, and back at the next move.
                    let stays = |&d: &usize| {
                        is_near(old, &around, parent, d) && inner.is_none_or(|inner| old.holds_along(&inner, d))
                    };
                    for d in (0..3).filter(stays) {
                        (chosen.min[d], chosen.max[d]) = (old.min[d], old.max[d]);
                    }
                }
                moved |= kept.get(a) != Some(&chosen);
                boxes.push(chosen);
            }
            self.boxes[level] = boxes;
        }
        moved
    }

    /// The leeway of an agent before [`follow`](Self::follow) moves anything, rounded to the safe side.
    pub fn leeway(&self, agent: usize) -> Leeway {
        let around = AROUND_AGENT.ceil() as i32;
        let (mut ends, mut sums) = (CellBox { min: [i32::MIN; 3], max: [i32::MAX; 3] }, [[i32::MIN; 3], [i32::MAX; 3]]);
        for (level, boxes) in self.boxes.iter().enumerate() {
            let Some(one) = boxes.get(agent) else { continue };
            // Twice as far as the middle.
            let off = (2.0 * DEAD_ZONE * f64::from(2 << level)).floor() as i32;
            for d in 0..3 {
                let (min, max) = (one.min[d] << level, one.max[d] << level);
                ends.min[d] = ends.min[d].max(min + around + 1);
                ends.max[d] = ends.max[d].min(max - around - 1);
                sums[0][d] = sums[0][d].max(min + max - off + 1);
                sums[1][d] = sums[1][d].min(min + max + off - 1);
            }
        }
        Leeway { ends, sums, least: [i32::MAX; 3] }
    }

    /// How far along each axis an agent with the given bounds may move before [`follow`](Self::follow) moves anything:
    /// least and greatest displacement of the ends of its box [m].
    pub fn leash(&self, agent: usize, bounds: &Aabb) -> Aabb {
        let mut leash = Aabb::UNBOUND;
        let around = bounds.grown(AROUND_AGENT * self.h);
        for (level, boxes) in self.boxes.iter().enumerate() {
            let Some(one) = boxes.get(agent) else { continue };
            let cell = self.h * f64::from(1 << level);
            for d in 0..3 {
                let (min, max) = (cell * f64::from(one.min[d]), cell * f64::from(one.max[d]));
                let off = 0.5 * (around.min[d] + around.max[d]) - 0.5 * (min + max);
                let dead = DEAD_ZONE * 2.0 * cell;
                leash.min[d] = leash.min[d].max(min - around.min[d]).max(-dead - off);
                leash.max[d] = leash.max[d].min(max - around.max[d]).min(dead - off);
            }
        }
        leash
    }

    /// Whether only the ground around agents is live.
    pub fn unbounded(&self) -> bool {
        self.reach > 0
    }

    /// The tile of a cell of the finest level.
    pub fn tile_of(&self, cell: [i32; 3]) -> [i32; 2] {
        [cell[0], cell[1]].map(|c| (c >> self.boxes.len()).div_euclid(TILE))
    }

    /// Cells of the finest level that a tile holds along x and y: first, and one past the last.
    pub fn cells_of_tile(&self, tile: [i32; 2]) -> [[i32; 2]; 2] {
        tile.map(|t| [t * TILE, (t + 1) * TILE].map(|c| c << self.boxes.len()))
    }

    /// Tiles that lie in the world, in the order of their numbers: least and greatest along x and y.
    pub fn tiles_of_world(&self) -> [[i32; 2]; 2] {
        let ([x0, y0, _], [x1, y1, _]) = (self.world.min, self.world.max);
        let ([x0, y0], [x1, y1]) = (self.tile_of([x0, y0, 0]), self.tile_of([x1 - 1, y1 - 1, 0]));
        [[x0, x1], [y0, y1]]
    }

    /// Does a tile lie in the world?
    pub fn is_tile_of_world(&self, tile: [i32; 2]) -> bool {
        tile.iter().zip(self.tiles_of_world()).all(|(t, [first, last])| (first..=last).contains(t))
    }

    /// Tiles that are live for the present boxes: those within reach, and those of `live` that are less than a tile
    /// beyond. So an agent that trembles neither adds nor removes tiles.
    pub fn reached(&self, live: &BTreeSet<[i32; 2]>) -> BTreeSet<[i32; 2]> {
        let world = self.tiles_of_world();
        let mut reached = BTreeSet::new();
        for one in self.boxes.last().into_iter().flatten().map(CellBox::in_parents) {
            let tiles = |by: i32| -> [[i32; 2]; 2] {
                let grown = one.grown(by);
                std::array::from_fn(|d| {
                    let [first, last] = world[d];
                    [
                        grown.min[d].div_euclid(TILE).clamp(first, last + 1),
                        (grown.max[d] - 1).div_euclid(TILE).clamp(first - 1, last),
                    ]
                })
            };
            let [[x0, x1], [y0, y1]] = tiles(self.reach);
            reached.extend((x0..=x1).flat_map(|x| (y0..=y1).map(move |y| [x, y])));
            let [[x0, x1], [y0, y1]] = tiles(self.reach + TILE);
            reached.extend(live.iter().filter(|[x, y]| (x0..=x1).contains(x) && (y0..=y1).contains(y)));
        }
        reached
    }

    /// Whether a level's region holds a cell of that level. Cells behind a wall count as the cell next to the wall.
    pub fn contains(&self, level: usize, cell: [i32; 3]) -> bool {
        level == self.boxes.len() || self.cover(level, CellBox { min: cell, max: cell.map(|c| c + 1) }) == Cover::All
    }

    /// How much of a box of cells of a level its particles can touch. Particles lie up to [`SPLIT_AHEAD`] outside the
    /// region when they are sorted, drift by a cell, and touch the next cell's node.
    pub fn touched(&self, level: usize, cells: CellBox) -> Cover {
        self.cover_grown(level, cells, 2 * SPLIT_AHEAD + 2)
    }

    /// How much of a box of cells of a level lies in its region.
    pub fn cover(&self, level: usize, cells: CellBox) -> Cover {
        self.cover_grown(level, cells, 0)
    }

    /// The finest level whose region, grown by `margin` of its parent cells, holds all of a box of cells of the finest
    /// level; `None` if the cells differ in that.
    pub fn finest(&self, cells: CellBox, margin: i32) -> Option<usize> {
        for level in 0..self.boxes.len() {
            let scaled = CellBox { min: cells.min.map(|x| x >> level), max: cells.max.map(|x| ((x - 1) >> level) + 1) };
            match self.cover_grown(level, scaled, 2 * margin) {
                Cover::All => return Some(level),
                Cover::Part => return None,
                Cover::None => {}
            }
        }
        Some(self.boxes.len())
    }

    /// The finest level whose region, grown by `margin` of its parent cells, holds a cell of the finest level.
    pub fn finest_at(&self, cell: [i32; 3], margin: i32) -> usize {
        self.finest(CellBox { min: cell, max: cell.map(|c| c + 1) }, margin).unwrap_or(0)
    }

    /// Of an agent's box on a level: how many of some cells of the level, all in the world, are in it or so near that their particles belong there. `None`:
    /// it has none.
    pub(crate) fn count_in<'a>(
        &self,
        level: usize,
        agent: usize,
        cells: impl Iterator<Item = &'a [i32; 3]>,
    ) -> Option<usize> {
        let one = self.boxes.get(level)?.get(agent)?.grown(2 * SPLIT_AHEAD);
        let turn: [i32; 3] = std::array::from_fn(|d| (self.world.max[d] - self.world.min[d]) >> level);
        let holds = |d: usize, cell: i32| {
            let from = if self.periodic[d] { (cell - one.min[d]).rem_euclid(turn[d]) } else { cell - one.min[d] };
            (0..one.max[d] - one.min[d]).contains(&from)
        };
        Some(cells.filter(|cell| (0..3).all(|d| holds(d, cell[d]))).count())
    }

    fn cover_grown(&self, level: usize, mut cells: CellBox, by: i32) -> Cover {
        let Some(boxes) = self.boxes.get(level) else { return Cover::All };
        let world =
            CellBox { min: self.world.min.map(|x| x >> level), max: self.world.max.map(|x| ((x - 1) >> level) + 1) };
        for d in 0..3 {
            if self.walled[d][0] {
                (cells.min[d], cells.max[d]) = (cells.min[d].max(world.min[d]), cells.max[d].max(world.min[d] + 1));
            }
            if self.walled[d][1] {
                (cells.min[d], cells.max[d]) = (cells.min[d].min(world.max[d] - 1), cells.max[d].min(world.max[d]));
            }
        }
        // The copies of a box that periodic axes make: at most 27.
        let turns = self.periodic.map(i32::from);
        let mut cover = Cover::None;
        for one in boxes {
            let one = one.grown(by);
            for x in -turns[0]..=turns[0] {
                for y in -turns[1]..=turns[1] {
                    for z in -turns[2]..=turns[2] {
                        let turn = [x, y, z];
                        let cells = cells.moved(std::array::from_fn(|d| turn[d] * (world.max[d] - world.min[d])));
                        if one.holds(&cells) {
                            return Cover::All;
                        }
                        if one.meets(&cells) {
                            cover = Cover::Part;
                        }
                    }
                }
            }
        }
        cover
    }
}

/// Parent cells from the origin, beyond which a box follows nobody: its ends stay whole numbers of 32 bits however far an agent flies.
const FARTHEST: f64 = (1 << 21) as f64;

/// The box about an agent, of whole parent cells of width `parent` [m], with so many `half` cells of the level from its middle to each side, or more: it also
/// holds `inner` (in cells of the level).
fn ideal(agent: &Aabb, half: u32, inner: Option<CellBox>, parent: f64) -> CellBox {
    let mut chosen = CellBox { min: [0; 3], max: [0; 3] };
    for d in 0..3 {
        let centre = (0.5 * (agent.min[d] + agent.max[d]) / parent).round().clamp(-FARTHEST, FARTHEST) as i32;
        let reach = |end: f64| {
            let end = (end / parent).clamp(-FARTHEST, FARTHEST);
            ((end - f64::from(centre)).abs() + 1.0).ceil() as i32
        };
        let half = (half as i32 / 2).max(reach(agent.min[d])).max(reach(agent.max[d]));
        (chosen.min[d], chosen.max[d]) = (2 * (centre - half), 2 * (centre + half));
        if let Some(inner) = inner {
            chosen.min[d] = chosen.min[d].min(inner.min[d] >> 1 << 1);
            chosen.max[d] = chosen.max[d].max((inner.max[d] + 1) >> 1 << 1);
        }
    }
    chosen
}

/// Is the agent still inside the box along an axis, and near enough to its middle?
fn is_near(of: &CellBox, agent: &Aabb, parent: f64, d: usize) -> bool {
    let (min, max) = (0.5 * parent * f64::from(of.min[d]), 0.5 * parent * f64::from(of.max[d]));
    let off = 0.5 * (agent.min[d] + agent.max[d]) - 0.5 * (min + max);
    off.abs() <= DEAD_ZONE * parent && min <= agent.min[d] && agent.max[d] <= max
}

/// What a level's boxes follow, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Agent {
    /// What it is.
    pub followed: Followed,
    /// Cells of a level from the middle of its box to each side.
    pub half: u32,
    /// Whether only the bottom of its bounds is followed.
    pub lowest: bool,
    /// How far from there boxes are [m].
    pub offset: Vec3,
}

/// What boxes can follow.
#[derive(Clone, Debug, PartialEq)]
pub enum Followed {
    /// Bodies of couplings, by name: the box around them all.
    Rigid(Vec<String>),
    /// A soft body, by its index in the scene.
    Soft(u16),
    /// A box that stays where it is [m].
    Fixed(Aabb),
}

/// What an agent's boxes are to stand around.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// The finest box holds this and four cells around it [m].
    pub bounds: Aabb,
    /// Cells of a level from the middle of a box to each side.
    pub half: u32,
}

impl Agent {
    /// Boxes around all of something, with so many `half` cells from their middle to each side.
    pub const fn around(followed: Followed, half: u32) -> Self {
        Self { followed, half, lowest: false, offset: [0.0; 3] }
    }

    /// Whether a coupling's body is this, or one of these.
    pub fn is_of(&self, body: &str) -> bool {
        matches!(&self.followed, Followed::Rigid(names) if names.iter().any(|name| name == body))
    }

    /// Whether its finest box holds all of what is followed, wherever it goes.
    pub fn surrounds(&self) -> bool {
        !self.lowest && self.offset == [0.0; 3]
    }

    /// What its boxes are to stand around, where what is followed has these bounds.
    pub fn target(&self, mut bounds: Aabb) -> Target {
        if self.lowest {
            bounds.max[2] = bounds.min[2];
        }
        if self.offset != [0.0; 3] {
            let moved = |end: Vec3| std::array::from_fn(|d| end[d] + self.offset[d]);
            bounds = Aabb { min: moved(bounds.min), max: moved(bounds.max) };
        }
        Target { bounds, half: self.half }
    }

    /// The leeway of what is followed, from that of its [target](Self::target), rounded to the safe side; `h` is the width of the finest cells [m].
    pub fn leeway(&self, of_target: Leeway, h: f64) -> Leeway {
        let Leeway { mut ends, mut sums, mut least } = of_target;
        let by = self.offset.map(|offset| offset / h);
        for d in 0..3 {
            ends.min[d] = ends.min[d].saturating_add((-by[d]).ceil() as i32);
            ends.max[d] = ends.max[d].saturating_add((-by[d]).floor() as i32);
            sums[0][d] = sums[0][d].saturating_add((-2.0 * by[d]).ceil() as i32);
            sums[1][d] = sums[1][d].saturating_add((-2.0 * by[d]).floor() as i32);
        }
        if self.lowest {
            // Both ends of the target are the lower end of what is followed. Half of an odd sum is rounded inwards.
            let [from, to] = [sums[0][2].div_euclid(2) + (sums[0][2] & 1), sums[1][2].div_euclid(2)];
            ends.min[2] = ends.min[2].max(from);
            least[2] = ends.max[2].min(to);
            (ends.max[2], sums[0][2], sums[1][2]) = (i32::MAX, i32::MIN, i32::MAX);
        }
        Leeway { ends, sums, least }
    }
}

/// The name of a robot's link, where a coupling calls it by both names: `robot/link`.
pub(crate) fn link_of<'a>(robot: &str, body: &'a str) -> Option<&'a str> {
    body.strip_prefix(robot)?.strip_prefix('/')
}

/// What boxes are to stand around, for each agent that is there: those that couplings move and those that stay; soft ones are looked up in `soft`.
pub fn targets(agents: &[Agent], couplings: &[Box<dyn Coupling>], soft: impl Fn(u16) -> Option<Aabb>) -> Vec<Target> {
    let rigid: Vec<(BodyState, Aabb)> =
        couplings.iter().flat_map(|coupling| coupling.bodies().into_iter().zip(coupling.extents())).collect();
    let bounds = |agent: &Agent| match &agent.followed {
        Followed::Rigid(names) => {
            let own = names.iter().filter_map(|name| rigid.iter().find(|(body, _)| body.name == *name));
            own.map(|(_, bounds)| *bounds).reduce(|all, bounds| all.union(&bounds))
        }
        Followed::Soft(body) => soft(*body),
        Followed::Fixed(bounds) => Some(*bounds),
    };
    agents.iter().filter_map(|agent| Some(agent.target(bounds(agent)?))).collect()
}

/// Depth of the ground where each level has the surface [m]: the median over columns one coarsest cell wide, each its
/// volume over its area. `None` for a level without surface.
pub(crate) fn surface_depths(particles: &ParticleState, levels: usize) -> Vec<Option<f64>> {
    #[derive(Default)]
    struct Column {
        /// [m]
        depth: f64,
        /// Height and level of the topmost particle.
        top: Option<(f64, usize)>,
    }
    let mut columns: HashMap<[i32; 2], Column> = HashMap::new();
    for list in &particles.lists {
        let level = list.level as usize;
        let shift = levels - 1 - level;
        let width = list.cell_width * f64::from(1 << shift);
        for (i, cell) in list.cell.iter().enumerate() {
            let column = columns.entry([cell[0] >> shift, cell[1] >> shift]).or_default();
            column.depth += list.volume0[i] / (width * width);
            let height = list.position(i)[2];
            if column.top.is_none_or(|(top, _)| height > top) {
                column.top = Some((height, level));
            }
        }
    }
    let mut depths = vec![Vec::new(); levels];
    for Column { depth, top } in columns.into_values() {
        depths[top.map_or(0, |(_, level)| level)].push(depth);
    }
    let median = |mut depths: Vec<f64>| {
        let middle = depths.len() / 2;
        (!depths.is_empty()).then(|| *depths.select_nth_unstable_by(middle, f64::total_cmp).1)
    };
    depths.into_iter().map(median).collect()
}

/// The finest cell that holds a point [m].
pub fn cell_of(x: Vec3, h: f64) -> [i32; 3] {
    x.map(|x| (x / h).floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn regions(levels: u32) -> Regions {
        Regions {
            h: 0.01,
            reach: 0,
            world: CellBox { min: [-4000; 3], max: [4000; 3] },
            walled: [[false; 2], [false; 2], [true, false]],
            periodic: [false; 3],
            boxes: vec![Vec::new(); levels as usize - 1],
        }
    }

    fn agent(x: f64, z: f64) -> Target {
        Target { bounds: Aabb { min: [x - 0.03, -0.03, z], max: [x + 0.03, 0.03, z + 0.06] }, half: 16 }
    }

    /// Boxes of whole parent cells, nested with a margin: what the two-scale exchange relies on.
    #[test]
    fn boxes_are_aligned_nested_and_hold_the_agent() {
        let mut regions = regions(4);
        for step in 0..500 {
            let x = 3.0 * (0.02 * f64::from(step)).sin();
            regions.follow(&[agent(x, 0.1)]);
            for (level, boxes) in regions.boxes.iter().enumerate() {
                let one = boxes[0];
                assert!(one.min.iter().chain(&one.max).all(|c| c % 2 == 0), "{one:?}");
                if level > 0 {
                    assert!(one.holds(&regions.boxes[level - 1][0].in_parents().grown(NESTING)), "level {level}");
                }
            }
            assert_eq!(regions.finest_at(cell_of([x, 0.0, 0.12], 0.01), 0), 0);
        }
    }

    /// An agent that trembles by a parent cell moves nothing; one that walks off moves its boxes.
    #[test]
    fn the_dead_zone_keeps_boxes_still() {
        let mut regions = regions(3);
        assert!(regions.follow(&[agent(0.0, 0.1)]));
        for step in 0..100 {
            assert!(!regions.follow(&[agent(if step % 2 == 0 { 0.02 } else { -0.02 }, 0.1)]));
        }
        assert!(regions.follow(&[agent(0.06, 0.1)]));
    }

    /// A foot is lifted while it swings forward: its boxes go forward and stay where they are in height.
    #[test]
    fn boxes_move_along_the_axes_on_which_they_have_to() {
        let mut regions = regions(3);
        regions.follow(&[agent(0.0, 0.1)]);
        let before: Vec<CellBox> = regions.boxes.iter().map(|boxes| boxes[0]).collect();
        assert!(regions.follow(&[agent(0.1, 0.13)]));
        for (boxes, before) in regions.boxes.iter().zip(before) {
            assert!(boxes[0].min[0] > before.min[0], "{:?}", boxes[0]);
            assert_eq!([boxes[0].min[2], boxes[0].max[2]], [before.min[2], before.max[2]]);
        }
    }

    /// Symptom guarded against: a panic where cells of an agent that flew off, or was told to, do not fit in 32 bits.
    #[test]
    fn an_agent_beyond_all_cells_is_followed_to_the_last_of_them() {
        let mut regions = regions(3);
        for far in [1e9, -1e9, 1e300] {
            regions.follow(&[agent(far, far)]);
            for boxes in &regions.boxes {
                assert!((0..3).all(|d| boxes[0].min[d] < boxes[0].max[d]), "{:?}", boxes[0]);
                assert!(!boxes[0].meets(&regions.world), "{:?}", boxes[0]);
            }
        }
        let wide = Target { bounds: Aabb { min: [-1e9; 3], max: [1e9; 3] }, half: 16 };
        regions.follow(&[wide]);
        assert!(regions.boxes.iter().all(|boxes| boxes[0].holds(&regions.world)), "{:?}", regions.boxes);
        regions.follow(&[agent(0.0, 0.1)]);
        assert!(regions.contains(0, cell_of([0.0, 0.0, 0.12], 0.01)));
    }

    /// A box at a wall ends at the wall: what lies behind belongs to what lies before it.
    #[test]
    fn regions_go_on_behind_walls() {
        let mut regions = regions(2);
        regions.follow(&[agent(0.0, -40.0)]);
        assert!(regions.contains(0, [0, 0, -4000]));
        assert!(regions.contains(0, [0, 0, -4003]));
        assert!(!regions.contains(0, [100, 0, -4001]));
    }

    /// Tiles come within reach, stay for one tile more, and end with the world.
    #[test]
    fn tiles_that_are_live_do_not_flicker() {
        let mut regions = Regions { reach: 4, ..regions(3) };
        regions.follow(&[agent(0.0, 0.1)]);
        let first = regions.reached(&BTreeSet::new());
        assert_eq!(regions.reached(&first), first, "nothing changes while the boxes stay");
        // The coarsest box is 16 parents wide about the agent, 8 to 4 cells of which the reach adds.
        let box_ = regions.boxes[1][0];
        let tile = |c: i32| (c >> 1).div_euclid(TILE);
        let (x0, x1) = (tile(box_.min[0] - 8), tile(box_.max[0] + 8 - 1));
        assert!(first.contains(&[x0, 0]) && first.contains(&[x1, 0]));
        assert!(!first.contains(&[x0 - 1, 0]) && !first.contains(&[x1 + 1, 0]));
        regions.follow(&[agent(0.16, 0.1)]);
        let second = regions.reached(&first);
        assert!(second.contains(&[x0, 0]) && second.contains(&[x1 + 1, 0]), "{second:?}");
        regions.follow(&[agent(3.2, 0.1)]);
        let third = regions.reached(&second);
        assert!(third.is_disjoint(&second));
        assert!(third.len() <= first.len() + 2 * (x1 - x0 + 2) as usize, "{} and {}", third.len(), first.len());
        regions.follow(&[agent(40.0, 0.1)]);
        let [[_, last], _] = regions.tiles_of_world();
        let end = regions.reached(&third);
        assert!(end.iter().all(|[x, _]| *x <= last) && end.contains(&[last, 0]));
    }

    #[test]
    fn levels_are_told_apart_by_cells() {
        let mut regions = regions(3);
        regions.follow(&[agent(0.0, 0.1)]);
        let one = regions.boxes[0][0];
        let y = (one.min[1] + one.max[1]) / 2;
        let z = (one.min[2] + one.max[2]) / 2;
        assert_eq!(regions.finest_at([one.max[0] - 1, y, z], 0), 0);
        assert_eq!(regions.finest_at([one.max[0], y, z], 0), 1);
        assert_eq!(regions.finest_at([one.max[0] + 1, y, z], SPLIT_AHEAD), 0);
        assert_eq!(regions.finest_at([one.max[0] + 2, y, z], SPLIT_AHEAD), 1);
        let far = CellBox { min: [300; 3], max: [304; 3] };
        assert_eq!(regions.finest(far, 0), Some(2));
        let across = CellBox { min: [one.max[0] - 2, y, z], max: [one.max[0] + 2, y + 4, z + 4] };
        assert_eq!(regions.finest(across, 0), None);
    }
}
