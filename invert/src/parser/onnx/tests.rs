use cnerf_core::{region::Region, rng::Stream};
use image::Rgb;

use super::*;
use crate::parser::ParserConfig;

/// A protobuf field that holds bytes: a string, a message or packed numbers.
fn bytes(field: u32, content: &[u8]) -> Vec<u8> {
    [varint(u64::from(field << 3 | 2)), varint(content.len() as u64), content.to_vec()].concat()
}

/// A protobuf field that holds a whole number.
fn number(field: u32, value: u64) -> Vec<u8> {
    [varint(u64::from(field << 3)), varint(value)].concat()
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut encoded = Vec::new();
    while value >= 0x80 {
        encoded.push(value as u8 | 0x80);
        value >>= 7;
    }
    encoded.push(value as u8);
    encoded
}

fn value_info(name: &str, element: u64, shape: &[u64]) -> Vec<u8> {
    let dims: Vec<u8> = shape.iter().flat_map(|size| bytes(1, &number(1, *size))).collect();
    let tensor = [number(1, element), bytes(2, &dims)].concat();
    [bytes(1, name.as_bytes()), bytes(2, &bytes(1, &tensor))].concat()
}

fn node(operator: &str, inputs: &[&str], output: &str, attributes: &[Vec<u8>]) -> Vec<u8> {
    let mut node: Vec<u8> = inputs.iter().flat_map(|input| bytes(1, input.as_bytes())).collect();
    node.extend([bytes(2, output.as_bytes()), bytes(3, output.as_bytes()), bytes(4, operator.as_bytes())].concat());
    node.extend(attributes.iter().flat_map(|attribute| bytes(5, attribute)));
    node
}

fn attribute(name: &str, value: u64) -> Vec<u8> {
    [bytes(1, name.as_bytes()), number(3, value), number(20, 2)].concat()
}

/// A network of one 1x1 convolution by the identity: three classes, scored by red, green and blue. `labels` adds an
/// arg max.
pub(crate) fn identity(input: &[u64], labels: bool) -> Vec<u8> {
    const FLOAT: u64 = 1;
    const INT64: u64 = 7;
    let weights: Vec<u8> = (0..9).flat_map(|index| f32::from(u8::from(index % 4 == 0)).to_le_bytes()).collect();
    let dims: Vec<u8> = [3, 3, 1, 1].into_iter().flat_map(|size| number(1, size)).collect();
    let weights = [dims, number(2, FLOAT), bytes(8, b"w"), bytes(9, &weights)].concat();
    let mut graph = bytes(1, &node("Conv", &["x", "w"], "scores", &[]));
    if labels {
        graph.extend(bytes(
            1,
            &node("ArgMax", &["scores"], "labels", &[attribute("axis", 1), attribute("keepdims", 0)]),
        ));
    }
    graph.extend([bytes(2, b"parser"), bytes(5, &weights), bytes(11, &value_info("x", FLOAT, input))].concat());
    let output =
        if labels { value_info("labels", INT64, &[1, 16, 24]) } else { value_info("scores", FLOAT, &[1, 3, 16, 24]) };
    graph.extend(bytes(12, &output));
    [number(1, 8), bytes(7, &graph), bytes(8, &[bytes(1, b""), number(2, 13)].concat())].concat()
}

/// A network of one pooling: the mean of each channel, `[1, 3, 1, 1]`.
pub(crate) fn mean(input: &[u64]) -> Vec<u8> {
    let graph = [
        bytes(1, &node("GlobalAveragePool", &["x"], "mean", &[])),
        bytes(2, b"features"),
        bytes(11, &value_info("x", 1, input)),
        bytes(12, &value_info("mean", 1, &[1, 3, 1, 1])),
    ];
    [number(1, 8), bytes(7, &graph.concat()), bytes(8, &[bytes(1, b""), number(2, 13)].concat())].concat()
}

fn load(file: &[u8], classes: &[&str]) -> Result<OnnxParser> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("parser.onnx");
    std::fs::write(&path, file).unwrap();
    OnnxParser::load(&path, LabelScheme::from_class_names(classes)?, PixelScale::Symmetric)
}

const CLASSES: [&str; 3] = ["hair", "skin", "background"];

#[test]
fn scores_and_labels_become_regions_where_they_are() {
    for labels in [false, true] {
        let parser = load(&identity(&[1, 3, 16, 24], labels), &CLASSES).unwrap();
        assert_eq!(parser.side(), 16, "the shorter side of 24x16: bars stand left and right");
        // Red above, green below left, blue below right.
        let portrait = RgbImage::from_fn(32, 32, |x, y| match (x < 16, y < 16) {
            (_, true) => Rgb([250, 0, 20]),
            (true, false) => Rgb([0, 250, 20]),
            (false, false) => Rgb([0, 90, 250]),
        });
        let map = parser.parse(&portrait).unwrap().labels;
        assert_eq!((map.width(), map.height()), (16, 16));
        for (index, label) in map.labels().iter().enumerate() {
            let expected = match (index % 16 < 8, index / 16 < 8) {
                (_, true) => Region::Hair,
                (true, false) => Region::Face,
                (false, false) => Region::Background,
            };
            assert_eq!(Region::from_label(*label), Some(expected), "pixel {index}");
        }
    }
}

#[test]
fn networks_that_are_no_parsers_are_refused_in_one_line() {
    let said = |file: &[u8], classes: &[&str]| {
        let error = load(file, classes).err().expect("refused").to_string();
        assert!(error.contains("parser.onnx") && error.lines().count() == 1, "{error}");
        error
    };
    assert!(said(b"", &CLASSES).contains("ONNX"));
    assert!(said(b"not a network at all, but a text", &CLASSES).contains("ONNX"));
    assert!(said(&identity(&[1, 4, 16, 24], false), &CLASSES).contains("[1, 4, 16, 24]"));
    assert!(said(&identity(&[1, 3, 0, 24], false), &CLASSES).contains("pixels"));
    assert!(said(&identity(&[1, 3, 1 << 20, 24], false), &CLASSES).contains("2048"));
    assert!(said(&identity(&[1, 3, 16, 24], false), &["background", "hair"]).contains("--parser-classes"));
    let looping = [number(1, 8), bytes(7, &bytes(1, &node("Loop", &["x"], "y", &[])))].concat();
    assert!(said(&looping, &CLASSES).contains("`Loop`"));
    // A label the names do not reach shows when it occurs.
    let parser = load(&identity(&[1, 3, 16, 24], true), &CLASSES[..1]).unwrap();
    let error = parser.parse(&RgbImage::from_pixel(16, 16, Rgb([0, 0, 255]))).unwrap_err().to_string();
    assert!(error.contains("label") && error.contains("--parser-classes"), "{error}");
}

#[test]
fn mutated_files_neither_panic_nor_pass_for_pictures() {
    let file = identity(&[1, 3, 16, 24], false);
    let portrait = RgbImage::from_pixel(16, 16, Rgb([9, 200, 30]));
    let mut random = Stream::new(5, &[]);
    let mut refused = 0;
    for _ in 0..400 {
        let mut damaged = file.clone();
        for _ in 0..1 + random.below(3) {
            let place = random.below(damaged.len());
            damaged[place] = random.below(256) as u8;
        }
        damaged.truncate(damaged.len() - random.below(2) * random.below(40));
        // Either an error, or a map of regions: never a panic.
        refused += usize::from(load(&damaged, &CLASSES).and_then(|parser| parser.parse(&portrait)).is_err());
    }
    assert!(refused > 100, "{refused} of 400 damaged files were refused");
}

#[test]
fn the_shared_face_parser_finds_the_astronaut() {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/weights/face_parser_bisenetv2_448.onnx"));
    if !path.exists() {
        println!("skipped: {} is absent", path.display());
        return;
    }
    let config = ParserConfig { parser: Some(path.to_owned()), ..ParserConfig::default() };
    let parser = config.load(&[]).unwrap().unwrap();
    assert_eq!(parser.side(), 448);
    let photo = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/photos/astronaut.png"));
    let subject = crate::photo::Subject::read(photo, &Default::default(), Some(parser.as_ref()), 128).unwrap();
    let labels = subject.labels.unwrap();
    // Eyes and mouth as read off the photo by hand; hair above the forehead, the suit below the chin.
    let transform = subject.aligned.transform;
    for (x, y, region) in [
        (204.0, 101.0, Region::Eyes),
        (248.0, 103.0, Region::Eyes),
        (224.0, 145.0, Region::Mouth),
        (225.0, 125.0, Region::Nose),
        (200.0, 130.0, Region::Face),
        (180.0, 60.0, Region::Hair),
    ] {
        let (u, v) = transform.crop_point(x, y);
        let at = |place: f64, length: u32| ((place + 1.0) / 2.0 * f64::from(length)) as usize;
        let index = at(v, labels.height()) * labels.width() as usize + at(u, labels.width());
        assert_eq!(Region::from_label(labels.labels()[index]), Some(region), "at {x}, {y}");
    }
}
