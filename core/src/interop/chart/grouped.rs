//! Horizontal bars in groups, for names too long to stand side by side.

use plotters::{
    element::DashedPathElement,
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};

use super::{FONT, colour, draw, fault};
use crate::error::Result;

/// Bars that belong together.
#[derive(Clone, Debug)]
pub struct Group {
    /// What they measure.
    pub label: String,
    /// Name and value of each; equal names have one colour all over the chart.
    pub bars: Vec<(String, f64)>,
}

/// Horizontal bars from zero, group under group.
#[derive(Clone, Copy, Debug)]
pub struct GroupedBars<'a> {
    /// Above the chart.
    pub title: &'a str,
    /// Under the title: where and with what it was measured.
    pub subtitle: &'a str,
    /// Quantity and unit of the values, and which direction is better.
    pub unit: &'a str,
    /// The bars, from the top.
    pub groups: &'a [Group],
    /// Dashed lines: name and value.
    pub limits: &'a [(String, f64)],
}

impl<'a> GroupedBars<'a> {
    /// Seconds a frame.
    pub fn seconds_a_frame(title: &'a str, subtitle: &'a str, groups: &'a [Group]) -> Self {
        Self { title, subtitle, unit: "seconds a frame; shorter is faster", groups, limits: &[] }
    }

    /// The chart as SVG.
    ///
    /// # Errors
    /// [`crate::Error::Config`] if nothing can be drawn.
    pub fn svg(&self) -> Result<String> {
        let Self { title, subtitle, unit, groups, limits } = *self;
        let lines = groups.iter().map(|group| group.bars.len() + 1).sum::<usize>() as f64 + 0.5;
        let values = groups.iter().flat_map(|group| &group.bars).map(|(_, value)| *value);
        let largest =
            values.chain(limits.iter().map(|limit| limit.1)).filter(|value| value.is_finite()).fold(0.0, f64::max);
        let most = if largest > 0.0 { 1.4 * largest } else { 1.0 };
        let mut names: Vec<&str> = Vec::new();
        for (name, _) in groups.iter().flat_map(|group| &group.bars) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        let height = 140 + (24.0 * lines) as u32;
        draw(height, (title, subtitle), |area| {
            let mut chart = ChartBuilder::on(area)
                .margin_right(24)
                .margin_left(12)
                .x_label_area_size(48)
                .y_label_area_size(250)
                .build_cartesian_2d(0.0..most, 0.0..lines)
                .map_err(fault)?;
            chart
                .configure_mesh()
                .disable_y_mesh()
                .disable_y_axis()
                .y_labels(0)
                .x_desc(unit)
                .x_label_formatter(&|value| short(*value))
                .light_line_style(WHITE)
                .label_style((FONT, 14))
                .draw()
                .map_err(fault)?;
            let right = TextStyle::from((FONT, 14).into_font()).pos(Pos::new(HPos::Right, VPos::Center));
            let left = TextStyle::from((FONT, 13).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
            let mut line = lines - 0.5;
            for group in groups {
                for (index, (name, value)) in group.bars.iter().enumerate() {
                    let (top, bottom) = (line - 0.08, line - 0.92);
                    line -= 1.0;
                    let middle = 0.5 * (top + bottom);
                    let colour = colour(names.iter().position(|known| known == name).unwrap_or_default());
                    let value = if value.is_finite() { *value } else { 0.0 };
                    let bar = Rectangle::new([(0.0, top), (value, bottom)], colour.filled());
                    chart.draw_series([bar]).map_err(fault)?;
                    let text = format!("{} {name}", short(value));
                    let text = EmptyElement::at((value, middle)) + Text::new(text, (6, 0), left.clone());
                    chart.draw_series([text]).map_err(fault)?;
                    if index == group.bars.len() / 2 {
                        let between = if group.bars.len().is_multiple_of(2) { top + 0.08 } else { middle };
                        let label =
                            EmptyElement::at((0.0, between)) + Text::new(group.label.clone(), (-8, 0), right.clone());
                        chart.draw_series([label]).map_err(fault)?;
                    }
                }
                line -= 1.0;
            }
            for (name, value) in limits {
                let path = [(*value, 0.0), (*value, lines)];
                let dashes = DashedPathElement::new(path, 6, 4, BLACK.stroke_width(1));
                chart.draw_series([dashes]).map_err(fault)?;
                let text = EmptyElement::at((*value, 0.0)) + Text::new(name.clone(), (4, -10), (FONT, 12).into_font());
                chart.draw_series([text]).map_err(fault)?;
            }
            Ok(())
        })
    }
}

/// A number as short as it can be read: 0.00021, 3.4, 1200, 3e7.
fn short(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e6).contains(&size) {
        return format!("{value:.1e}").replace(".0e", "e");
    }
    let decimals = (2 - size.log10().floor() as i32).clamp(0, 5) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (value, text) in [(0.0, "0"), (2e-4, "2e-4"), (0.25, "0.25"), (3.4, "3.4"), (1234.0, "1234"), (3e7, "3e7")]
        {
            assert_eq!(short(value), text);
        }
    }

    #[test]
    fn bars_name_their_groups_units_and_limits() {
        let groups = [Group { label: "a frame".into(), bars: vec![("fused".into(), 3.5), ("plain".into(), f64::NAN)] }];
        let limits = [("a ceiling".into(), 4.0)];
        let chart = GroupedBars {
            title: "A title",
            subtitle: "a machine, 2 threads",
            unit: "seconds",
            groups: &groups,
            limits: &limits,
        };
        let svg = chart.svg().unwrap();
        for text in ["A title", "a machine, 2 threads", "a frame", "seconds", "3.5 fused", "a ceiling"] {
            assert!(svg.contains(text), "no `{text}`");
        }
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
    }
}
