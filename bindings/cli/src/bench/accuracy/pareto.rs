//! What the ladder of uniform grids says about other runs: the time it takes for the same error, and its own order.

/// A uniform run: wall seconds, error.
pub(super) type Point = (f64, f64);

/// Wall seconds that the uniform ladder takes to reach an error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Time {
    /// Between two rungs, straight in logarithms.
    Between(f64),
    /// Beyond an end of the ladder, the nearest two rungs' line carried on, at the fine end by one more such rung at most.
    Beyond(f64),
    /// More than one rung beyond the fine end: more than that rung's time.
    MoreThan(f64),
    /// The ladder's error does not fall towards that end, or there are fewer than two rungs.
    Unknown,
}

/// The time at which the ladder, coarse to fine, first comes down to an error.
pub(super) fn time_to(ladder: &[Point], error: f64) -> Time {
    let on = |pair: &[Point]| {
        let share = (error / pair[0].1).ln() / (pair[1].1 / pair[0].1).ln();
        (pair[0].0.ln() + share * (pair[1].0 / pair[0].0).ln()).exp()
    };
    let beyond = |pair: &[Point]| if pair[1].1 < pair[0].1 { Time::Beyond(on(pair)) } else { Time::Unknown };
    let (Some(first), Some(last)) = (ladder.windows(2).next(), ladder.windows(2).last()) else { return Time::Unknown };
    if error > ladder[0].1 {
        return beyond(first);
    }
    let across = ladder.windows(2).find(|pair| (pair[1].1..=pair[0].1).contains(&error));
    // A line that hardly falls would meet any error in the end, and say nothing.
    let one_more = last[1].0 * last[1].0 / last[0].0;
    across.map_or_else(
        || match beyond(last) {
            Time::Beyond(seconds) if seconds > one_more => Time::MoreThan(one_more),
            time => time,
        },
        |pair| Time::Between(on(pair)),
    )
}

/// Order q and the reference's own error, from two rungs (cell width, error against the reference): an error a hᵠ seen from a
/// reference of cell `h` is a (hᵠ − h_refᵠ) (Richardson). `None` if no order from 0.5 to 4 fits: rungs whose errors hardly differ tell of none.
pub(super) fn order(coarse: (f64, f64), fine: (f64, f64), h: f64) -> Option<(f64, f64)> {
    let ratio = |q: f64| (coarse.0.powf(q) - h.powf(q)) / (fine.0.powf(q) - h.powf(q));
    let wanted = coarse.1 / fine.1;
    let (mut low, mut high) = (0.5, 4.0);
    if !(ratio(low)..=ratio(high)).contains(&wanted) {
        return None;
    }
    // The ratio grows with the order: halved until the order is known to 1e-9.
    for _ in 0..32 {
        let middle = 0.5 * (low + high);
        if ratio(middle) < wanted { low = middle } else { high = middle }
    }
    let scale = fine.1 / (fine.0.powf(low) - h.powf(low));
    Some((low, scale * h.powf(low)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Error 8 / t: a straight line in logarithms.
    const LADDER: [Point; 3] = [(1.0, 8.0), (4.0, 2.0), (16.0, 0.5)];

    #[test]
    fn times_are_read_off_the_line() {
        let near = |seconds: f64, wanted: f64| (seconds / wanted - 1.0).abs() < 1e-9;
        assert!(matches!(time_to(&LADDER, 1.0), Time::Between(seconds) if near(seconds, 8.0)));
        assert!(matches!(time_to(&LADDER, 0.25), Time::Beyond(seconds) if near(seconds, 32.0)));
        assert!(matches!(time_to(&LADDER, 16.0), Time::Beyond(seconds) if near(seconds, 0.5)));
        assert_eq!(time_to(&LADDER, 0.1), Time::MoreThan(64.0));
        assert_eq!(time_to(&LADDER[..1], 1.0), Time::Unknown);
        assert_eq!(time_to(&[(1.0, 2.0), (4.0, 3.0)], 1.0), Time::Unknown);
    }

    #[test]
    fn the_order_is_found_again() {
        let error = |h: f64| 3.0 * (h.powf(1.5) - 0.01f64.powf(1.5));
        let (q, own) = order((0.04, error(0.04)), (0.02, error(0.02)), 0.01).unwrap();
        assert!((q - 1.5).abs() < 1e-6 && (own / (3.0 * 0.01f64.powf(1.5)) - 1.0).abs() < 1e-6);
        assert_eq!(order((0.04, 1.0), (0.02, 2.0), 0.01), None);
    }
}
