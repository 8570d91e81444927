//! Axes of charts: where values lie, and round ticks.

use std::ops::Range;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};

/// Share of a chart's height that is kept free for its legend.
const LEGEND_ROOM: f64 = 0.18;
/// Axes aim at this many ticks.
const TICKS: f64 = 6.0;

/// One axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// What is shown and its unit, e.g. `time per frame, seconds`.
    pub title: String,
    /// Powers of ten at equal distances. Values that are not positive are left out.
    pub logarithmic: bool,
    /// Whether 0 must be on the axis; without effect on a logarithmic one.
    pub from_zero: bool,
}

impl Axis {
    /// A linear axis.
    pub fn linear(title: impl Into<String>) -> Self {
        Self { title: title.into(), ..Self::default() }
    }

    /// A logarithmic axis.
    pub fn logarithmic(title: impl Into<String>) -> Self {
        Self { logarithmic: true, ..Self::linear(title) }
    }

    /// The same axis with 0 on it.
    #[must_use]
    pub fn with_zero(self) -> Self {
        Self { from_zero: true, ..self }
    }

    /// Where on the axis a value lies; none if it cannot be shown.
    pub(super) fn place(&self, value: f64) -> Option<f64> {
        let place = if self.logarithmic { value.log10() } else { value };
        place.is_finite().then_some(place)
    }

    pub(super) fn label(&self, place: f64) -> String {
        if !self.logarithmic {
            return number(place);
        }
        // Even steps of less than a decade are at no round values.
        let unit = 10f64.powf(place.floor() - 1.0);
        number((10f64.powf(place) / unit).round() * unit)
    }

    /// Ends and ticks of an axis that shows all `places`.
    pub(super) fn ruler(&self, places: impl Iterator<Item = f64>) -> Ruler {
        let (mut low, mut high) = places.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        if self.from_zero && !self.logarithmic {
            (low, high) = (low.min(0.0), high.max(0.0));
        }
        if high - low < 1e-12 * high.abs().max(1e-12) {
            let margin = if low == 0.0 || self.logarithmic { 0.5 } else { 0.05 * low.abs() };
            (low, high) = (low - margin, high + margin);
        }
        let ticks = if self.logarithmic && high - low > 0.6 {
            decades(low, high)
        } else {
            let step = round_step((high - low) / TICKS);
            (low, high) = ((low / step).floor() * step, (high / step).ceil() * step);
            (0..=((high - low) / step).round() as usize).map(|index| low + index as f64 * step).collect()
        };
        Ruler { low, high, ticks }
    }
}

/// The ends and ticks of an axis, in places.
#[derive(Clone, Debug)]
pub(super) struct Ruler {
    pub low: f64,
    pub high: f64,
    pub ticks: Vec<f64>,
}

impl Ruler {
    /// Room for a legend above everything drawn, if there is one.
    pub fn below_legend(self, wanted: bool) -> Self {
        let room = if wanted { LEGEND_ROOM * (self.high - self.low) } else { 0.0 };
        Self { high: self.high + room, ..self }
    }
}

impl Ranged for Ruler {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (first, last): (i32, i32)) -> i32 {
        let share = (value - self.low) / (self.high - self.low);
        first + (share * f64::from(last - first)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() { Vec::new() } else { self.ticks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

/// Ticks of a logarithmic axis: powers of ten, and their doubles and halves where there is room.
fn decades(low: f64, high: f64) -> Vec<f64> {
    let factors: &[f64] = if high - low > 3.0 { &[1.0] } else { &[1.0, 2.0, 5.0] };
    let powers = low.floor() as i32..=high.ceil() as i32;
    let ticks = powers.flat_map(|power| factors.iter().map(move |factor| factor.log10() + f64::from(power)));
    ticks.filter(|tick| (low - 1e-9..=high + 1e-9).contains(tick)).collect()
}

/// The next of 1, 2 and 5 times a power of ten.
fn round_step(step: f64) -> f64 {
    let power = 10f64.powf(step.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|factor| factor * power).find(|round| *round >= step).unwrap_or(step)
}

/// A number with as many digits as a tick needs.
fn number(value: f64) -> String {
    // Multiples of a step such as 0.1 end in …0001.
    let rounded = (value * 1e9).round() / 1e9;
    let size = value.abs();
    if size != 0.0 && !(1e-4..1e6).contains(&size) { format!("{value:.1e}") } else { format!("{rounded}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_cover_the_values() {
        let Ruler { low, high, ticks } = Axis::linear("").ruler([0.13, 0.97].into_iter());
        assert!(low <= 0.13 && high >= 0.97 && (4..=10).contains(&ticks.len()), "{low} {high} {ticks:?}");
        assert_eq!(number(ticks[0]), "0");
        let Ruler { low, high, ticks } = Axis::logarithmic("").ruler([-3.2, 2.1].into_iter());
        assert_eq!((low, high, ticks), (-3.2, 2.1, vec![-3.0, -2.0, -1.0, 0.0, 1.0, 2.0]));
        // One value, no value: still a range to draw in.
        for values in [vec![], vec![0.0], vec![5.0], vec![-1e-20]] {
            let Ruler { low, high, ticks } = Axis::linear("").ruler(values.iter().copied());
            assert!(low < high && ticks.len() > 1, "{values:?}: {low} {high} {ticks:?}");
        }
    }

    #[test]
    fn numbers_are_short() {
        let shown = [0.1 + 0.2, 1e-7, 2e7, -0.05, 64.0].map(number);
        assert_eq!(shown, ["0.3", "1.0e-7", "2.0e7", "-0.05", "64"]);
    }
}
