//! Stopwatches: ways to do the same thing are timed in turns, so that whatever else the machine does hits them alike.

use std::time::Instant;

use serde::Serialize;

use crate::error::Result;

/// Seconds that one way took.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Timing {
    /// The middle one.
    pub median_seconds: f64,
    /// The fastest.
    pub least_seconds: f64,
    /// The slowest.
    pub most_seconds: f64,
    /// How many were timed, after one that was not.
    pub repeats: usize,
}

impl Timing {
    /// Of at least one measurement; of none, all zero.
    pub fn of(mut seconds: Vec<f64>) -> Self {
        seconds.sort_by(f64::total_cmp);
        let at = |index: usize| seconds.get(index).copied().unwrap_or_default();
        let last = seconds.len().saturating_sub(1);
        Self {
            median_seconds: 0.5 * (at(last / 2) + at(seconds.len() / 2)),
            least_seconds: at(0),
            most_seconds: at(last),
            repeats: seconds.len(),
        }
    }
}

/// A way to do something.
pub type Way<'a> = Box<dyn FnMut() -> Result<()> + 'a>;

/// Does every way once untimed, then `repeats` rounds of each way once, timed.
pub fn in_turns(repeats: usize, ways: &mut [Way<'_>]) -> Result<Vec<Timing>> {
    for way in ways.iter_mut() {
        way()?;
    }
    let mut seconds = vec![Vec::with_capacity(repeats); ways.len()];
    for _ in 0..repeats.max(1) {
        for (way, seconds) in ways.iter_mut().zip(&mut seconds) {
            let began = Instant::now();
            way()?;
            seconds.push(began.elapsed().as_secs_f64());
        }
    }
    Ok(seconds.into_iter().map(Timing::of).collect())
}

/// ‖found − expected‖ / ‖expected‖ over all values of both; 0 where both are zero.
pub fn relative_l2(found: &[f64], expected: &[f64]) -> f64 {
    let squares = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
    let difference = squares(&mut found.iter().zip(expected).map(|(found, expected)| found - expected));
    let size = squares(&mut expected.iter().copied());
    if difference == 0.0 { 0.0 } else { (difference / size.max(f64::MIN_POSITIVE)).sqrt() }
}

/// Threads that the kernels run on.
pub fn threads() -> usize {
    rayon::current_num_threads()
}

/// The most memory that this process ever held, bytes; none where the system does not tell.
pub fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_ignore_order_and_outliers() {
        let timing = Timing::of(vec![9.0, 1.0, 2.0]);
        assert_eq!((timing.median_seconds, timing.least_seconds, timing.most_seconds), (2.0, 1.0, 9.0));
        assert_eq!(Timing::of(vec![1.0, 3.0]).median_seconds, 2.0);
    }

    #[test]
    fn ways_take_turns_after_one_warm_up() {
        let order = std::cell::RefCell::new(String::new());
        let note = |name: char| -> Way<'_> {
            let order = &order;
            Box::new(move || {
                order.borrow_mut().push(name);
                Ok(())
            })
        };
        let timings = in_turns(2, &mut [note('a'), note('b')]).unwrap();
        assert_eq!((order.borrow().as_str(), timings[1].repeats), ("ababab", 2));
    }

    #[test]
    fn relative_errors_are_exact_at_zero() {
        assert_eq!(relative_l2(&[0.0, 0.0], &[0.0, 0.0]), 0.0);
        assert!((relative_l2(&[3.0, 4.4], &[3.0, 4.0]) - 0.08).abs() < 1e-12);
        assert!(relative_l2(&[1e-9], &[0.0]) > 1.0);
    }
}
