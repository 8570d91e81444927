//! Means of many inversions.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{InversionScore, NovelView, Scores};

/// Novel views are gathered by how far they are turned, this many bins a radian.
const BINS_PER_RAD: f64 = 10.0;

/// Novel views turned about as far from their photos.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TurnSummary {
    /// How far, either way, radians, to the next tenth.
    pub turn_rad: f64,
    /// Views.
    pub count: usize,
    /// Mean, dB.
    pub psnr: f64,
    /// Mean without the background, dB; none without masks.
    pub foreground_psnr: Option<f64>,
}

impl TurnSummary {
    /// `views` by how far their azimuth is turned, nearest first.
    fn of<'a>(views: impl Iterator<Item = &'a NovelView>) -> Vec<Self> {
        let mut bins: BTreeMap<u64, Vec<&NovelView>> = BTreeMap::new();
        for view in views {
            bins.entry((view.azimuth_turn_rad.abs() * BINS_PER_RAD).round() as u64).or_default().push(view);
        }
        let summary = |(bin, views): (u64, Vec<&NovelView>)| Self {
            turn_rad: bin as f64 / BINS_PER_RAD,
            count: views.len(),
            psnr: mean(views.iter().map(|view| view.psnr)).unwrap_or_default(),
            foreground_psnr: mean(views.iter().filter_map(|view| view.foreground_psnr)),
        };
        bins.into_iter().map(summary).collect()
    }
}

pub(super) fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / count as f64)
}

/// The means of several inversions.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct InversionSummary {
    /// Photos inverted.
    pub count: usize,
    /// Photos that could not be.
    pub failed: usize,
    /// Of what was inverted.
    #[serde(flatten)]
    pub mean: Scores,
    /// PSNR of novel views by how far they are turned.
    pub novel_views_by_turn: Vec<TurnSummary>,
}

impl InversionSummary {
    /// The means of `scores`; what a photo lacks is left out of the mean.
    pub fn of(scores: &[InversionScore], failed: usize) -> Self {
        let of = |value: fn(&Scores) -> Option<f64>| mean(scores.iter().filter_map(|score| value(&score.scores)));
        let mean = Scores {
            seconds: of(|score| Some(score.seconds)).unwrap_or_default(),
            psnr: of(|score| Some(score.psnr)).unwrap_or_default(),
            ms_ssim: of(|score| Some(score.ms_ssim)).unwrap_or_default(),
            lpips: of(|score| score.lpips),
            mask_miou: of(|score| score.mask_miou),
            novel_view_psnr: of(|score| score.novel_view_psnr),
            novel_view_foreground_psnr: of(|score| score.novel_view_foreground_psnr),
            depth_correlation: of(|score| score.depth_correlation),
            pose_error_rad: of(|score| score.pose_error_rad),
            depth_drift: of(|score| Some(score.depth_drift)).unwrap_or_default(),
        };
        let novel_views_by_turn = TurnSummary::of(scores.iter().flat_map(|score| &score.novel_views));
        Self { count: scores.len(), failed, mean, novel_views_by_turn }
    }
}

impl InversionSummary {
    /// Novel views turned by so many radians, to the next tenth.
    pub fn turned(&self, turn_rad: f64) -> Option<&TurnSummary> {
        self.novel_views_by_turn.iter().find(|turn| (turn.turn_rad - turn_rad).abs() < 0.5 / BINS_PER_RAD)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_gathered_by_how_far_they_are_turned_either_way() {
        let view = |azimuth_turn_rad: f64, psnr: f64, foreground_psnr: Option<f64>| NovelView {
            azimuth_turn_rad,
            elevation_turn_rad: 0.0,
            psnr,
            foreground_psnr,
        };
        let one = InversionScore {
            novel_views: vec![view(-0.4, 20.0, Some(18.0)), view(0.2, 24.0, None)],
            ..InversionScore::default()
        };
        let other = InversionScore { novel_views: vec![view(0.41, 22.0, None)], ..InversionScore::default() };
        let summary = InversionSummary::of(&[one, other], 1);
        assert_eq!((summary.count, summary.failed, summary.novel_views_by_turn.len()), (2, 1, 2));
        let far = TurnSummary { turn_rad: 0.4, count: 2, psnr: 21.0, foreground_psnr: Some(18.0) };
        assert_eq!(summary.turned(0.4), Some(&far));
        assert_eq!(summary.turned(0.2).map(|turn| (turn.count, turn.psnr)), Some((1, 24.0)));
        assert_eq!(summary.turned(0.3), None);
    }
}
