//! Face parsers in ONNX format, run by `tract-onnx`.
//!
//! The file comes from anywhere: it is checked for what a parser must be (one picture in, one label map or one map of
//! scores out, all sizes known and bounded) before it runs, and a panic inside the ONNX library becomes an error.

use std::{
    io::Cursor,
    panic::{self, AssertUnwindSafe},
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

use cnerf_core::data::{
    labels::{LabelMap, LabelScheme},
    picture,
};
use image::{GrayImage, Luma, RgbImage};
use tract_onnx::{
    onnx, pb::GraphProto, prelude::*, tract_core::internal::DimLike as _, tract_hir::infer::Factoid as _,
};

use super::{Parsed, PixelScale, RegionParser};
use crate::error::{Error, Result};

/// Largest ONNX file read, bytes.
pub(crate) const LARGEST_FILE: u64 = 512 << 20;
/// Most nodes a graph may have.
const MOST_NODES: usize = 20_000;
/// Most values any tensor inside the network may have: 4 GiB of f32 is more than a parser needs by far.
const MOST_VALUES: usize = 1 << 28;
/// What a network is to be used as, for messages.
const PURPOSE: &str = "face parser";
/// Width and height of the network's input, pixels.
const SIDES: std::ops::RangeInclusive<usize> = 8..=2048;
/// Operators whose work or output has no bound that the graph tells.
const UNBOUNDED: [&str; 4] = ["Loop", "Scan", "If", "Range"];

pub(crate) type Network = Arc<TypedRunnableModel>;

/// A face parser.
pub struct OnnxParser {
    path: PathBuf,
    network: Network,
    scheme: LabelScheme,
    scale: PixelScale,
    input: Input,
    output: Output,
}

/// What the network takes: `[1, 3, height, width]`, or `[1, height, width, 3]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Input {
    pub width: usize,
    pub height: usize,
    channels_last: bool,
}

impl Input {
    /// A picture of this size as the network wants it.
    pub(crate) fn tensor(self, picture: &RgbImage, scale: PixelScale) -> TractResult<Tensor> {
        let Self { width, height, channels_last } = self;
        let value =
            |channel: usize, x: usize, y: usize| scale.apply(channel, picture.get_pixel(x as u32, y as u32).0[channel]);
        let mut values = Vec::with_capacity(3 * width * height);
        if channels_last {
            (0..height)
                .for_each(|y| (0..width).for_each(|x| values.extend((0..3).map(|channel| value(channel, x, y)))));
            Tensor::from_shape(&[1, height, width, 3], &values)
        } else {
            (0..3)
                .for_each(|channel| (0..height).for_each(|y| values.extend((0..width).map(|x| value(channel, x, y)))));
            Tensor::from_shape(&[1, 3, height, width], &values)
        }
    }
}

/// What the network gives, at its own width and height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Output {
    /// Integers, one a pixel.
    Labels { width: usize, height: usize },
    /// `[1, classes, height, width]`.
    ScoresFirst { width: usize, height: usize, classes: usize },
    /// `[1, height, width, classes]`.
    ScoresLast { width: usize, height: usize, classes: usize },
}

impl OnnxParser {
    /// Loads a parser whose label values mean what `scheme` says and which wants its colours as `scale` says.
    ///
    /// Errors name the file: it cannot be read, is no ONNX file, or is no face parser with as many classes as `scheme`.
    pub fn load(path: &Path, scheme: LabelScheme, scale: PixelScale) -> Result<Self> {
        let bytes = picture::read_file(path, LARGEST_FILE)?;
        let refuse = |reason: String| Error::malformed(path, reason);
        let (network, input) = contained(PURPOSE, || network(&bytes, PURPOSE)).map_err(refuse)?;
        let fact = contained(PURPOSE, || network.model().output_fact(0).cloned().map_err(one_line)).map_err(refuse)?;
        let shape = fact.shape.as_concrete().map(<[usize]>::to_vec);
        let shape =
            shape.ok_or_else(|| refuse("the size of its output is not fixed; export it with fixed sizes".into()))?;
        let output = Output::of(&shape, fact.datum_type, scheme.len(), input.channels_last).map_err(refuse)?;
        Ok(Self { path: path.to_owned(), network, scheme, scale, input, output })
    }

    /// The portrait at the network's size; one that is not square gets grey bars.
    fn letterboxed(&self, portrait: &RgbImage) -> Result<(RgbImage, [usize; 3])> {
        let Input { width, height, .. } = self.input;
        let side = width.min(height);
        let (left, top) = ((width - side) / 2, (height - side) / 2);
        let scaled = picture::resize(portrait, side as u32, side as u32)?;
        let mut boxed = RgbImage::from_pixel(width as u32, height as u32, image::Rgb([128; 3]));
        image::imageops::replace(&mut boxed, &scaled, left as i64, top as i64);
        Ok((boxed, [left, top, side]))
    }

    /// The network's label at every pixel of its output, in row order.
    fn labels(&self, output: &Tensor) -> std::result::Result<Vec<i64>, String> {
        match self.output {
            Output::Labels { .. } => {
                let labels = output.cast_to::<i64>().map_err(one_line)?;
                let view = labels.try_as_plain_ram().map_err(one_line)?;
                Ok(view.as_slice::<i64>().map_err(one_line)?.to_vec())
            }
            Output::ScoresFirst { width, height, classes } | Output::ScoresLast { width, height, classes } => {
                let scores = output.cast_to::<f32>().map_err(one_line)?;
                let view = scores.try_as_plain_ram().map_err(one_line)?;
                let scores = view.as_slice::<f32>().map_err(one_line)?;
                let first = matches!(self.output, Output::ScoresFirst { .. });
                let score = |pixel: usize, class: usize| {
                    let index = if first { class * width * height + pixel } else { pixel * classes + class };
                    scores.get(index).copied().unwrap_or(f32::NEG_INFINITY)
                };
                let best = |pixel: usize| {
                    (1..classes).fold(
                        0,
                        |best, class| {
                            if score(pixel, class) > score(pixel, best) { class } else { best }
                        },
                    )
                };
                Ok((0..width * height).map(|pixel| best(pixel) as i64).collect())
            }
        }
    }
}

impl RegionParser for OnnxParser {
    fn side(&self) -> u32 {
        self.input.width.min(self.input.height) as u32
    }

    fn parse(&self, portrait: &RgbImage) -> Result<Parsed> {
        let refuse = |reason: String| Error::malformed(&self.path, reason);
        let (boxed, [left, top, side]) = self.letterboxed(portrait)?;
        let labels = contained(PURPOSE, || {
            let input = self.input.tensor(&boxed, self.scale).map_err(one_line)?;
            let outputs = self.network.run(tvec!(input.into())).map_err(one_line)?;
            let output = outputs.first().ok_or("gives no output; give another parser")?;
            self.labels(output)
        });
        let labels = labels.map_err(refuse)?;
        let (width, height) = self.output.size();
        if labels.len() != width * height {
            return Err(refuse(format!(
                "gave {} labels for {width}x{height} pixels; give another parser",
                labels.len()
            )));
        }
        let mut map = GrayImage::new(side as u32, side as u32);
        for (x, y, pixel) in map.enumerate_pixels_mut() {
            // Centre of the pixel in the network's input, then in its output.
            let column = (2 * (left + x as usize) + 1) * width / (2 * self.input.width);
            let row = (2 * (top + y as usize) + 1) * height / (2 * self.input.height);
            let label = labels.get(row.min(height - 1) * width + column.min(width - 1)).copied().unwrap_or(0);
            let known = u8::try_from(label).ok().filter(|label| usize::from(*label) < self.scheme.len());
            *pixel = Luma([known.ok_or_else(|| {
                let classes = self.scheme.len();
                refuse(format!("gave label {label}, but {classes} classes are known; name all by --parser-classes"))
            })?]);
        }
        Ok(Parsed { labels: LabelMap::translate(map, &self.scheme, &self.path)?, camera: None })
    }
}

impl Output {
    /// What an output of this shape and type is, if a parser of `classes` classes can give it.
    fn of(shape: &[usize], datum: DatumType, classes: usize, channels_last: bool) -> std::result::Result<Self, String> {
        let sound = |width: usize, height: usize| (1..=2048).contains(&width) && (1..=2048).contains(&height);
        let found = match *shape {
            [1, height, width] | [1, 1, height, width] | [1, height, width, 1] | [height, width]
                if datum.is_integer() && sound(width, height) =>
            {
                Some(Self::Labels { width, height })
            }
            [1, first, second, third] if datum.is_float() => {
                let leading = (first == classes && sound(third, second)).then_some(Self::ScoresFirst {
                    width: third,
                    height: second,
                    classes,
                });
                let trailing = (third == classes && sound(second, first)).then_some(Self::ScoresLast {
                    width: second,
                    height: first,
                    classes,
                });
                if channels_last { trailing.or(leading) } else { leading.or(trailing) }
            }
            _ => None,
        };
        found.ok_or_else(|| {
            format!(
                "gives {datum:?} {shape:?}; a parser gives integer labels [1, H, W] or scores [1, {classes}, H, W] of \
                 {classes} classes: name its classes by --parser-classes"
            )
        })
    }

    fn size(self) -> (usize, usize) {
        match self {
            Self::Labels { width, height }
            | Self::ScoresFirst { width, height, .. }
            | Self::ScoresLast { width, height, .. } => (width, height),
        }
    }
}

/// Reads and prepares a network of one picture in, and says how it wants the picture.
pub(crate) fn network(bytes: &[u8], purpose: &str) -> std::result::Result<(Network, Input), String> {
    let onnx = onnx();
    let proto = onnx
        .proto_model_for_read(&mut Cursor::new(bytes))
        .map_err(|error| format!("is no ONNX file ({}); give a {purpose} exported to ONNX", one_line(error)))?;
    let graph = proto.graph.as_ref();
    let graph = graph.ok_or_else(|| format!("holds no network; give a {purpose} exported to ONNX"))?;
    check_operators(graph, purpose)?;
    let unusable = |error: TractError| format!("cannot be run as a {purpose} ({})", one_line(error));
    let mut model = onnx.model_for_proto_model(&proto).map_err(unusable)?;
    if model.inputs.len() != 1 {
        return Err(format!("takes {} inputs; a {purpose} takes one picture", model.inputs.len()));
    }
    let fact = model.input_fact(0).map_err(unusable)?.clone();
    if fact.datum_type.concretize().is_some_and(|datum| datum != f32::datum_type()) {
        return Err(format!("takes {:?}; a {purpose} takes pictures of f32", fact.datum_type));
    }
    // The batch may be open: one picture at a time is given. Sizes may not: nobody says which are meant.
    let sizes: Vec<Option<usize>> =
        fact.shape.dims().map(|dim| dim.concretize().and_then(|dim| dim.to_usize().ok())).collect();
    let input = match *sizes.as_slice() {
        [None | Some(1), Some(3), Some(height), Some(width)] => Input { width, height, channels_last: false },
        [None | Some(1), Some(height), Some(width), Some(3)] => Input { width, height, channels_last: true },
        _ => {
            let shape: Vec<String> =
                sizes.iter().map(|size| size.map_or_else(|| "?".into(), |size| size.to_string())).collect();
            let shape = shape.join(", ");
            return Err(format!(
                "takes [{shape}]; a {purpose} takes one picture [1, 3, H, W] or [1, H, W, 3] of fixed size"
            ));
        }
    };
    let Input { width, height, channels_last } = input;
    if !SIDES.contains(&width) || !SIDES.contains(&height) {
        let (least, most) = (SIDES.start(), SIDES.end());
        return Err(format!("takes pictures of {width}x{height} pixels; {least} to {most} a side are possible"));
    }
    let shape = if channels_last { [1, height, width, 3] } else { [1, 3, height, width] };
    model.set_input_fact(0, f32::fact(shape).into()).map_err(unusable)?;
    let typed = model.into_typed().map_err(unusable)?;
    for fact in typed.nodes().iter().flat_map(|node| &node.outputs).map(|outlet| &outlet.fact) {
        let values = fact
            .shape
            .as_concrete()
            .and_then(|shape| shape.iter().try_fold(1usize, |values, length| values.checked_mul(*length)));
        if values.is_none_or(|values| values > MOST_VALUES) {
            return Err("has tensors of unknown or unreasonable size; export it with fixed sizes".into());
        }
    }
    let first = typed.output_outlets().map_err(unusable)?.first().copied().ok_or("gives no output")?;
    // Parsers often give auxiliary maps of their training after the first.
    let optimised = typed.with_output_outlets(&[first]).and_then(TypedModel::into_optimized).map_err(unusable)?;
    Ok((optimised.into_runnable().map_err(unusable)?, input))
}

/// Refuses graphs that are too large and operators that may run for ever, in subgraphs too.
fn check_operators(graph: &GraphProto, purpose: &str) -> std::result::Result<(), String> {
    if graph.node.len() > MOST_NODES {
        return Err(format!("has {} nodes; a {purpose} has fewer than {MOST_NODES}", graph.node.len()));
    }
    match graph.node.iter().find(|node| UNBOUNDED.contains(&node.op_type.as_str())) {
        Some(node) => Err(format!("uses the operator `{}`, which no {purpose} needs", node.op_type)),
        None => Ok(()),
    }
}

/// Runs `work`; a panic in it is an error and prints nothing. The ONNX library trusts its files more than is good.
pub(crate) fn contained<T>(
    purpose: &str,
    work: impl FnOnce() -> std::result::Result<T, String>,
) -> std::result::Result<T, String> {
    // One at a time: the panic hook belongs to the process.
    static HOOK: Mutex<()> = Mutex::new(());
    let _guard = HOOK.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let outcome = panic::catch_unwind(AssertUnwindSafe(work));
    panic::set_hook(hook);
    outcome.unwrap_or_else(|_| Err(format!("is damaged or not a {purpose}; give another file")))
}

/// An error of the ONNX library and its causes, shortened to part of a line.
pub(crate) fn one_line(error: impl Into<TractError>) -> String {
    let text = format!("{:#}", error.into());
    let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    match line.char_indices().nth(160) {
        Some((end, _)) => format!("{} ...", &line[..end]),
        None => line,
    }
}

#[cfg(test)]
pub(super) mod tests;
