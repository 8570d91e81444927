//! The charts a person looks at: horizontal bars and curves, as SVG. Every chart names its units and the machine.

use plotters::{
    coord::Shift,
    element::DashedPathElement,
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};

use crate::error::{Error, Result};

/// Colours that stay apart for the colour-blind (Okabe and Ito, 2008).
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];
const WIDTH: u32 = 900;
const FONT: &str = "sans-serif";

/// What every chart says around its picture.
#[derive(Clone, Copy, Debug)]
pub struct Caption<'a> {
    /// What is shown.
    pub title: &'a str,
    /// Where and with what it was measured.
    pub subtitle: &'a str,
}

/// Bars that belong together.
#[derive(Clone, Debug)]
pub struct Group {
    /// What they measure.
    pub label: String,
    /// Name and value of each; equal names have one colour all over the chart.
    pub bars: Vec<(String, f64)>,
}

/// One axis.
#[derive(Clone, Copy, Debug)]
pub struct Axis<'a> {
    /// Quantity and unit.
    pub label: &'a str,
    /// Whether equal ratios, not equal differences, are equally far apart.
    pub logarithmic: bool,
}

/// Points, joined in order of their x unless `joined` is unset.
#[derive(Clone, Debug)]
pub struct Curve {
    /// The legend's entry.
    pub name: String,
    /// (x, y).
    pub points: Vec<(f64, f64)>,
    /// Whether a line joins them.
    pub joined: bool,
    /// Whether it is a limit, drawn dashed and without points.
    pub limit: bool,
}

fn failed(error: impl std::fmt::Display) -> Error {
    Error::config("chart", error)
}

/// SVG text of horizontal bars from zero, with dashed lines at `limits` (name, value).
pub fn bars(caption: Caption<'_>, unit: &str, groups: &[Group], limits: &[(String, f64)]) -> Result<String> {
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
    let mut svg = String::new();
    {
        let height = 140 + (24.0 * lines) as u32;
        let area = titled(&mut svg, caption, height)?;
        let mut chart = ChartBuilder::on(&area)
            .margin_right(24)
            .margin_left(12)
            .x_label_area_size(48)
            .y_label_area_size(250)
            .build_cartesian_2d(0.0..most, 0.0..lines)
            .map_err(failed)?;
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
            .map_err(failed)?;
        let right = TextStyle::from((FONT, 14).into_font()).pos(Pos::new(HPos::Right, VPos::Center));
        let left = TextStyle::from((FONT, 13).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
        let mut line = lines - 0.5;
        for group in groups {
            for (index, (name, value)) in group.bars.iter().enumerate() {
                let (top, bottom) = (line - 0.08, line - 0.92);
                line -= 1.0;
                let middle = 0.5 * (top + bottom);
                let colour = COLOURS[names.iter().position(|known| known == name).unwrap_or_default() % COLOURS.len()];
                let value = if value.is_finite() { *value } else { 0.0 };
                let bar = Rectangle::new([(0.0, top), (value, bottom)], colour.filled());
                chart.draw_series([bar]).map_err(failed)?;
                let text = format!("{} {name}", short(value));
                let text = EmptyElement::at((value, middle)) + Text::new(text, (6, 0), left.clone());
                chart.draw_series([text]).map_err(failed)?;
                if index == group.bars.len() / 2 {
                    let between = if group.bars.len().is_multiple_of(2) { top + 0.08 } else { middle };
                    let label =
                        EmptyElement::at((0.0, between)) + Text::new(group.label.clone(), (-8, 0), right.clone());
                    chart.draw_series([label]).map_err(failed)?;
                }
            }
            line -= 1.0;
        }
        for (name, value) in limits {
            let path = [(*value, 0.0), (*value, lines)];
            let dashes = DashedPathElement::new(path, 6, 4, BLACK.stroke_width(1));
            chart.draw_series([dashes]).map_err(failed)?;
            let text = EmptyElement::at((*value, 0.0)) + Text::new(name.clone(), (4, -10), (FONT, 12).into_font());
            chart.draw_series([text]).map_err(failed)?;
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// SVG text of curves over two axes; points that an axis cannot show (zero on a logarithmic one) are left out.
pub fn curves(caption: Caption<'_>, x: Axis<'_>, y: Axis<'_>, curves: &[Curve]) -> Result<String> {
    let shown = |axis: Axis<'_>, value: f64| value.is_finite() && (!axis.logarithmic || value > 0.0);
    // Logarithmic axes are linear ones of the logarithm, so that one code draws all four kinds.
    let place = |axis: Axis<'_>, value: f64| if axis.logarithmic { value.log10() } else { value };
    let curves: Vec<Curve> = curves
        .iter()
        .map(|curve| {
            let kept = curve.points.iter().filter(|point| shown(x, point.0) && shown(y, point.1));
            let mut points: Vec<_> = kept.map(|point| (place(x, point.0), place(y, point.1))).collect();
            points.sort_by(|left, right| left.0.total_cmp(&right.0));
            Curve { points, ..curve.clone() }
        })
        .collect();
    let all = || curves.iter().flat_map(|curve| &curve.points);
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        let margin = (0.06 * (high - low)).max(1e-9 + 0.05 * high.abs().min(1.0));
        low - margin..high + margin
    };
    let mut svg = String::new();
    {
        let area = titled(&mut svg, caption, 560)?;
        let mut chart = ChartBuilder::on(&area)
            .margin_right(28)
            .margin_left(12)
            .x_label_area_size(52)
            .y_label_area_size(84)
            .build_cartesian_2d(range(&mut all().map(|point| point.0)), range(&mut all().map(|point| point.1)))
            .map_err(failed)?;
        let written = |axis: Axis<'_>, value: f64| short(if axis.logarithmic { 10f64.powf(value) } else { value });
        chart
            .configure_mesh()
            .x_desc(x.label)
            .y_desc(y.label)
            .x_label_formatter(&|value| written(x, *value))
            .y_label_formatter(&|value| written(y, *value))
            .light_line_style(WHITE)
            .label_style((FONT, 14))
            .draw()
            .map_err(failed)?;
        for (index, curve) in curves.iter().enumerate() {
            let colour = if curve.limit { RGBColor(90, 90, 90) } else { COLOURS[index % COLOURS.len()] };
            let style = colour.stroke_width(2);
            if curve.limit {
                let dashes = DashedPathElement::new(curve.points.clone(), 6, 4, style);
                let drawn = chart.draw_series([dashes]).map_err(failed)?;
                drawn.label(&curve.name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
                continue;
            }
            if curve.joined {
                chart.draw_series(LineSeries::new(curve.points.clone(), style)).map_err(failed)?;
            }
            let dots = curve.points.iter().map(|point| Circle::new(*point, 4, colour.filled()));
            let drawn = chart.draw_series(dots).map_err(failed)?;
            drawn.label(&curve.name).legend(move |(x, y)| Circle::new((x + 9, y), 4, colour.filled()));
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(190, 190, 190))
            .label_font((FONT, 13))
            .draw()
            .map_err(failed)?;
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

fn titled<'a>(svg: &'a mut String, caption: Caption<'_>, height: u32) -> Result<DrawingArea<SVGBackend<'a>, Shift>> {
    let area = SVGBackend::with_string(svg, (WIDTH, height)).into_drawing_area();
    area.fill(&WHITE).map_err(failed)?;
    let area = area.titled(caption.title, (FONT, 20)).map_err(failed)?;
    area.titled(caption.subtitle, TextStyle::from((FONT, 12).into_font()).color(&RGBColor(90, 90, 90))).map_err(failed)
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

    const CAPTION: Caption<'_> = Caption { title: "A title", subtitle: "a machine, 2 threads" };

    #[test]
    fn numbers_are_short() {
        for (value, text) in [(0.0, "0"), (2e-4, "2e-4"), (0.25, "0.25"), (3.4, "3.4"), (1234.0, "1234"), (3e7, "3e7")]
        {
            assert_eq!(short(value), text);
        }
    }

    #[test]
    fn bars_name_their_groups_units_and_limits() {
        let group = Group { label: "a frame".into(), bars: vec![("fused".into(), 3.5), ("plain".into(), f64::NAN)] };
        let svg = bars(CAPTION, "seconds", &[group], &[("a ceiling".into(), 4.0)]).unwrap();
        for text in ["A title", "a machine, 2 threads", "a frame", "seconds", "3.5 fused", "a ceiling"] {
            assert!(svg.contains(text), "no `{text}`");
        }
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
    }

    #[test]
    fn curves_survive_what_they_cannot_show() {
        let curve =
            |points: &[(f64, f64)], limit| Curve { name: "one".into(), points: points.to_vec(), joined: true, limit };
        let axis = |logarithmic| Axis { label: "an axis, s", logarithmic };
        for points in [&[][..], &[(0.0, 0.0)], &[(1.0, f64::INFINITY), (2.0, 5.0)], &[(1e-3, 1e9), (10.0, 1.0)]] {
            for logarithmic in [false, true] {
                for limit in [false, true] {
                    let svg = curves(CAPTION, axis(logarithmic), axis(logarithmic), &[curve(points, limit)]).unwrap();
                    assert!(svg.contains("an axis, s") && !svg.contains("NaN"));
                }
            }
        }
    }
}
