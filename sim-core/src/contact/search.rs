//! How far to go along a step of Newton's method.

/// What may be out of balance along a step behind it, as a part of what was before it, in either direction.
const BALANCED: f64 = 0.2;
/// Places that are tried along a step.
const MAX_TRIES: u32 = 20;
/// One in so many of them is in the middle of where the place may be.
const HALVED: u32 = 3;

/// Looks along a step for where nothing is out of balance along it any more, by false position (Illinois). Where bounds are reached on the way, a whole step may lead far beyond
/// that place; and one that is cut back to well before it leads nowhere, since the same bounds are in the way of the next one.
#[derive(Debug)]
pub struct Search {
    before: f64,
    part: f64,
    /// Parts of the step on either side of the place, and what is out of balance there.
    ends: [(f64, f64); 2],
    /// The end that moved last.
    moved: Option<usize>,
    tries: u32,
}

impl Search {
    /// Looks along a step before which so much is out of balance along it [J]. `look` says of a part of the step what it leads to, and how much is left there [J]; all of the step is
    /// tried first. Returns the part to go, and what it leads to.
    pub fn along<T>(before: f64, mut look: impl FnMut(f64) -> (T, f64)) -> (f64, T) {
        let mut search = Self::new(before);
        loop {
            let part = search.part;
            let (there, left) = look(part);
            if search.next(left).is_none() {
                return (part, there);
            }
        }
    }

    fn new(before: f64) -> Self {
        Self { before, part: 1.0, ends: [(0.0, before), (1.0, 0.0)], moved: None, tries: 1 }
    }

    /// The part of the step to try next, where so much is out of balance along it at the part tried last [J]; none if that will do.
    fn next(&mut self, left: f64) -> Option<f64> {
        let most = BALANCED * self.before;
        let will_do = left >= -most && (left <= most || self.part == 1.0);
        if will_do || !left.is_finite() || self.tries == MAX_TRIES {
            return None;
        }
        self.tries += 1;
        let end = usize::from(left < 0.0);
        self.ends[end] = (self.part, left);
        if self.moved == Some(end) {
            // So that the other end moves, too.
            self.ends[1 - end].1 *= 0.5;
        }
        self.moved = Some(end);
        let [(low, more), (high, less)] = self.ends;
        // Where what is left has a kink, that stays at one end for long: now and then the middle.
        self.part = if self.tries.is_multiple_of(HALVED) {
            0.5 * (low + high)
        } else {
            (low * less - high * more) / (less - more)
        };
        Some(self.part)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The part that a search ends with, and how often it looked.
    fn found(left: impl Fn(f64) -> f64) -> (f64, u32) {
        let mut looks = 0;
        let (part, ()) = Search::along(left(0.0), |part| {
            looks += 1;
            ((), left(part))
        });
        (part, looks)
    }

    /// A step that leads there, or not as far, is taken whole; others end where little is left, though all is won at one end or at the other.
    #[test]
    fn a_search_ends_where_little_is_left() {
        assert_eq!(found(|part| 1.0 - part), (1.0, 1));
        assert_eq!(found(|part| 1.0 - 0.3 * part), (1.0, 1));
        let steep_at_the_end = |part: f64| 1.0 - part - 1e3 * (part - 0.4).max(0.0);
        let steep_at_the_start = |part: f64| 1.0 - 1e3 * part.min(1e-3) - 0.3 * part;
        for left in [&steep_at_the_end as &dyn Fn(f64) -> f64, &steep_at_the_start] {
            let (part, looks) = found(left);
            println!("part {part} after {looks} looks: {} left", left(part));
            assert!(left(part).abs() <= BALANCED && looks <= 16, "{} left at {part}, {looks} looks", left(part));
        }
    }
}
