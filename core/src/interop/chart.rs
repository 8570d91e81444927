//! Charts of measurements as SVG files: lines over a number, bars over names, histograms. Every axis has a title with
//! its unit; colours are told apart by colour-blind people too (Okabe and Ito, 2008).

mod axis;
mod grouped;

use std::path::Path;

use plotters::{coord::Shift, element::DashedPathElement, prelude::*};

use self::axis::Ruler;
pub use self::{
    axis::Axis,
    grouped::{Group, GroupedBars},
};

use crate::{
    data::picture,
    error::{Error, Result},
};

/// Width of a chart, pixels.
const WIDTH: u32 = 900;
/// Height of a chart of two axes, pixels.
const HEIGHT: u32 = 540;
const FONT: &str = "sans-serif";
const PALETTE: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(90, 90, 90),
];
/// Of bounds and ceilings.
const LIMIT_COLOUR: RGBColor = RGBColor(90, 90, 90);

/// How a series is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mark {
    /// A line through the points.
    #[default]
    Line,
    /// A line, and a dot at each point: for few, measured points.
    LineAndDots,
    /// Dots alone.
    Dots,
    /// A dashed line: a bound or a ceiling.
    Limit,
}

/// A named line.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Shown in the legend.
    pub name: String,
    /// In drawing order; points that are not finite are left out.
    pub points: Vec<(f64, f64)>,
    /// How they are drawn.
    pub mark: Mark,
}

/// Lines over a number.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LineChart {
    /// Above the chart.
    pub title: String,
    /// Under the title: where and with what it was measured. May be empty.
    pub subtitle: String,
    /// Across.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// The lines.
    pub series: Vec<Series>,
}

impl LineChart {
    /// The chart as SVG.
    ///
    /// # Errors
    /// [`Error::Config`] if nothing can be drawn.
    pub fn svg(&self) -> Result<String> {
        let lines: Vec<Vec<(f64, f64)>> = self
            .series
            .iter()
            .map(|series| {
                let points = series.points.iter();
                points.filter_map(|&(x, y)| Some((self.x.place(x)?, self.y.place(y)?))).collect()
            })
            .collect();
        let x = self.x.ruler(lines.iter().flatten().map(|point| point.0));
        let named = self.series.iter().any(|series| !series.name.is_empty());
        let y = self.y.ruler(lines.iter().flatten().map(|point| point.1)).below_legend(named);
        draw(HEIGHT, (&self.title, &self.subtitle), |area| {
            let mut chart = frame(area, (&x, &y))?;
            mesh(&mut chart, (&self.x.title, &|place| self.x.label(*place)), (&self.y, &|place| self.y.label(*place)))?;
            for (index, (series, line)) in self.series.iter().zip(&lines).enumerate() {
                let colour = if series.mark == Mark::Limit { LIMIT_COLOUR } else { colour(index) };
                let stroke = colour.stroke_width(2);
                let drawn = match series.mark {
                    Mark::Line | Mark::LineAndDots => {
                        chart.draw_series(LineSeries::new(line.iter().copied(), stroke)).map_err(fault)?
                    }
                    Mark::Limit => {
                        chart.draw_series([DashedPathElement::new(line.clone(), 6, 4, stroke)]).map_err(fault)?
                    }
                    Mark::Dots => chart.draw_series(dots(line, colour)).map_err(fault)?,
                };
                match series.mark {
                    _ if series.name.is_empty() => {}
                    Mark::Dots => {
                        drawn.label(&series.name).legend(move |(x, y)| Circle::new((x + 9, y), 4, colour.filled()));
                    }
                    _ => {
                        drawn.label(&series.name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], stroke));
                    }
                }
                if series.mark == Mark::LineAndDots {
                    chart.draw_series(dots(line, colour)).map_err(fault)?;
                }
            }
            legend(&mut chart, named)
        })
    }

    /// Writes the chart to `path`, whole or not at all.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        picture::write_file(path.as_ref(), self.svg()?.as_bytes())
    }
}

/// Bars over names, side by side where there are several series.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BarChart {
    /// Above the chart.
    pub title: String,
    /// What the names are.
    pub x_title: String,
    /// Upwards; 0 is always on a linear axis.
    pub y: Axis,
    /// Name of each place.
    pub names: Vec<String>,
    /// Name in the legend (empty: none) and one value for every place; none draws no bar.
    pub series: Vec<(String, Vec<Option<f64>>)>,
}

impl BarChart {
    /// A chart of one value for every name.
    pub fn single(title: impl Into<String>, x_title: impl Into<String>, y: Axis, bars: &[(String, f64)]) -> Self {
        Self {
            title: title.into(),
            x_title: x_title.into(),
            y,
            names: bars.iter().map(|(name, _)| name.clone()).collect(),
            series: vec![(String::new(), bars.iter().map(|(_, value)| Some(*value)).collect())],
        }
    }

    /// The chart as SVG.
    ///
    /// # Errors
    /// [`Error::Config`] if nothing can be drawn.
    pub fn svg(&self) -> Result<String> {
        let y = Axis { from_zero: true, ..self.y.clone() };
        let values = self.series.iter().flat_map(|(_, values)| values).flatten();
        let named = self.series.iter().any(|(label, _)| !label.is_empty());
        let mut up = y.ruler(values.filter_map(|value| y.place(*value))).below_legend(named);
        if y.logarithmic {
            // The smallest bar must be seen too.
            up.low -= 0.1 * (up.high - up.low);
        }
        let base = if y.logarithmic { up.low } else { 0.0 };
        let places: Vec<f64> = (0..self.names.len()).map(|index| index as f64 + 0.5).collect();
        let across = Ruler { low: 0.0, high: self.names.len().max(1) as f64, ticks: places.clone() };
        let width = 0.8 / self.series.len().max(1) as f64;
        let name = |place: &f64| self.names.get(place.floor().max(0.0) as usize).cloned().unwrap_or_default();
        draw(HEIGHT, (&self.title, ""), |area| {
            let mut chart = frame(area, (&across, &up))?;
            mesh(&mut chart, (&self.x_title, &name), (&y, &|place| y.label(*place)))?;
            for (index, (label, values)) in self.series.iter().enumerate() {
                let colour = colour(index);
                let bars = values.iter().zip(&places).filter_map(|(value, place)| {
                    let top = y.place((*value)?)?;
                    let left = place - 0.4 + width * index as f64;
                    Some(Rectangle::new([(left, base), (left + 0.92 * width, top)], colour.filled()))
                });
                let drawn = chart.draw_series(bars).map_err(fault)?;
                if !label.is_empty() {
                    drawn
                        .label(label)
                        .legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 14, y + 5)], colour.filled()));
                }
            }
            legend(&mut chart, named)
        })
    }

    /// Writes the chart to `path`, whole or not at all.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        picture::write_file(path.as_ref(), self.svg()?.as_bytes())
    }
}

/// How often values fall into equal intervals: one stepped outline for every series, so that several can be compared.
pub fn histogram(title: impl Into<String>, x: Axis, series: &[(String, Vec<f64>)]) -> LineChart {
    const BINS: usize = 24;
    let places = || series.iter().flat_map(|(_, values)| values).filter_map(|value| x.place(*value));
    let Ruler { low, high, .. } = x.ruler(places());
    let width = (high - low) / BINS as f64;
    let value_at = |bin: usize| {
        let place = low + width * bin as f64;
        if x.logarithmic { 10f64.powf(place) } else { place }
    };
    let outline = |(name, values): &(String, Vec<f64>)| {
        let mut counts = [0usize; BINS];
        for place in values.iter().filter_map(|value| x.place(*value)) {
            let bin = (((place - low) / width) as usize).min(BINS - 1);
            counts[bin] += 1;
        }
        let mut points = vec![(value_at(0), 0.0)];
        for (bin, count) in counts.into_iter().enumerate() {
            points.extend([(value_at(bin), count as f64), (value_at(bin + 1), count as f64)]);
        }
        points.push((value_at(BINS), 0.0));
        Series { name: name.clone(), points, mark: Mark::Line }
    };
    let series = series.iter().map(outline).collect();
    let y = Axis::linear("count").with_zero();
    LineChart { title: title.into(), subtitle: String::new(), x, y, series }
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<Ruler, Ruler>>;

/// SVG text of what `content` draws under a title and a subtitle.
fn draw(height: u32, (title, subtitle): (&str, &str), content: impl FnOnce(&Area<'_>) -> Result<()>) -> Result<String> {
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, (WIDTH, height)).into_drawing_area();
        area.fill(&WHITE).map_err(fault)?;
        let mut inner = area.titled(title, (FONT, 22)).map_err(fault)?;
        if !subtitle.is_empty() {
            inner = inner.titled(subtitle, (FONT, 13).into_font().color(&LIMIT_COLOUR)).map_err(fault)?;
        }
        content(&inner)?;
        area.present().map_err(fault)?;
    }
    Ok(text)
}

fn dots(line: &[(f64, f64)], colour: RGBColor) -> impl Iterator<Item = Circle<(f64, f64), i32>> + '_ {
    line.iter().map(move |&point| Circle::new(point, 4, colour.filled()))
}

fn frame<'a, 'b>(area: &'a Area<'b>, (x, y): (&Ruler, &Ruler)) -> Result<Chart<'a, 'b>> {
    ChartBuilder::on(area)
        .margin(16)
        .x_label_area_size(52)
        .y_label_area_size(84)
        .build_cartesian_2d(x.clone(), y.clone())
        .map_err(fault)
}

type Format<'a> = &'a dyn Fn(&f64) -> String;

fn mesh(chart: &mut Chart<'_, '_>, x: (&str, Format<'_>), y: (&Axis, Format<'_>)) -> Result<()> {
    chart
        .configure_mesh()
        .x_desc(x.0)
        .y_desc(&y.0.title)
        .x_label_formatter(&x.1)
        .y_label_formatter(&y.1)
        .label_style((FONT, 14))
        .axis_desc_style((FONT, 16))
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.12))
        .draw()
        .map_err(fault)
}

fn legend<'a, 'b: 'a>(chart: &mut Chart<'a, 'b>, wanted: bool) -> Result<()> {
    if !wanted {
        return Ok(());
    }
    chart
        .configure_series_labels()
        .label_font((FONT, 14))
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK.mix(0.3))
        .position(SeriesLabelPosition::UpperRight)
        .draw()
        .map_err(fault)
}

fn colour(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

fn fault(error: impl std::fmt::Display) -> Error {
    Error::config("chart", format!("cannot be drawn: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charts_say_what_they_show() {
        let chart = LineChart {
            title: "time against error".into(),
            subtitle: "a machine".into(),
            x: Axis::logarithmic("time per frame, seconds"),
            y: Axis::linear("error, dB"),
            series: vec![Series {
                name: "ours".into(),
                points: vec![(0.1, 20.0), (0.0, 3.0), (2.0, 30.0)],
                mark: Mark::LineAndDots,
            }],
        };
        let svg = chart.svg().unwrap();
        for text in ["time against error", "a machine", "time per frame, seconds", "error, dB", "ours"] {
            assert!(svg.contains(text), "{text}");
        }
        // The point at 0 has no place on a logarithmic axis: two dots in the chart.
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(svg.trim_end().ends_with("</svg>"));

        let bars = [("hair".to_owned(), 0.2), ("neck".to_owned(), f64::NAN)];
        let svg = BarChart::single("changes", "region", Axis::linear("change, 0 to 1"), &bars).svg().unwrap();
        assert!(svg.contains("hair") && svg.contains("neck") && svg.contains("change, 0 to 1"));
    }

    #[test]
    fn lines_survive_what_they_cannot_show() {
        for points in [&[][..], &[(0.0, 0.0)], &[(1.0, f64::INFINITY), (2.0, 5.0)], &[(1e-3, 1e9), (10.0, 1.0)]] {
            for mark in [Mark::Line, Mark::LineAndDots, Mark::Dots, Mark::Limit] {
                for axis in [Axis::linear("an axis, s"), Axis::logarithmic("an axis, s")] {
                    let series = vec![Series { name: "one".into(), points: points.to_vec(), mark }];
                    let chart = LineChart { x: axis.clone(), y: axis, series, ..LineChart::default() };
                    let svg = chart.svg().unwrap();
                    assert!(svg.contains("an axis, s") && !svg.contains("NaN"));
                }
            }
        }
    }

    #[test]
    fn histograms_count_every_value_once() {
        let values = vec![1.0, 1.0, 2.0, 9.5, f64::NAN];
        let chart = histogram("", Axis::linear("x"), &[("a".into(), values)]);
        let tops = chart.series[0].points[1..].iter().step_by(2).map(|point| point.1);
        assert_eq!(tops.sum::<f64>(), 4.0);
    }
}
