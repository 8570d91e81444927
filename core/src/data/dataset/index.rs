//! `dataset.json`: what a dataset lists, in our form and in StyleGAN's.

use std::path::Path;

use serde_json::{Map, Value};

use super::files::Files;
use crate::{
    camera::{Camera, FIELD_OF_VIEW_RAD},
    data::labels::LabelScheme,
    error::{Error, Result},
};

/// One line of a dataset: a picture, what belongs to it, and whatever else its author wrote there.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Name of the photo's file in the dataset.
    pub image: String,
    /// Name of the label map's file.
    pub mask: Option<String>,
    /// Where the photo was seen from.
    pub camera: Option<Camera>,
    /// Every other field, kept on writing.
    pub extra: Map<String, Value>,
}

/// A parsed `dataset.json`.
pub(super) struct Index {
    pub(super) entries: Vec<Entry>,
    pub(super) scheme: LabelScheme,
    pub(super) extra: Map<String, Value>,
}

/// The camera's fields in an entry.
const CAMERA_FIELDS: [&str; 6] = ["azimuth", "elevation", "roll", "shift_x", "shift_y", "zoom"];

impl Index {
    /// Parses the bytes of `dataset.json`; `path` stands in errors, `files` tells which masks exist (StyleGAN's
    /// form does not name them).
    pub(super) fn parse(bytes: &[u8], path: &Path, files: &Files) -> Result<Self> {
        let refuse = |reason: String| Error::malformed(path, reason);
        let root: Value = serde_json::from_slice(bytes).map_err(|error| refuse(format!("not JSON ({error})")))?;
        let Value::Object(mut root) = root else {
            return Err(refuse("must be an object with `labels` and `items`".into()));
        };
        match root.remove("labels") {
            Some(Value::String(labels)) => {
                let classes = root.get("classes").map(|classes| class_names(classes, path)).transpose()?;
                let named = LabelScheme::named(&labels).ok_or_else(|| {
                    refuse(format!("labels `{labels}` is unknown; write `cnerf-9` or `celebamask-hq-19`"))
                })?;
                let scheme = match classes {
                    Some(names) => LabelScheme::from_class_names(&names).map_err(|error| refuse(error.to_string()))?,
                    None => named,
                };
                let Some(Value::Array(items)) = root.remove("items") else {
                    return Err(refuse("`items` must be an array".into()));
                };
                let entries = items.into_iter().enumerate().map(|(index, item)| parse_item(item, index, path));
                // `labels` and `classes` are written anew by whoever writes the set.
                root.remove("classes");
                Ok(Self { entries: entries.collect::<Result<_>>()?, scheme, extra: root })
            }
            Some(Value::Array(labels)) => {
                let entries = labels.iter().enumerate().map(|(index, label)| parse_stylegan(label, index, path, files));
                Ok(Self { entries: entries.collect::<Result<_>>()?, scheme: LabelScheme::cnerf(), extra: root })
            }
            _ => Err(refuse("`labels` must be `cnerf-9`, `celebamask-hq-19` or StyleGAN's array".into())),
        }
    }

    /// The bytes of a `dataset.json`, one item a line.
    pub(super) fn write(entries: &[Entry], extra: &Map<String, Value>) -> Vec<u8> {
        let mut head = Map::new();
        head.insert("labels".into(), "cnerf-9".into());
        head.extend(
            extra.iter().filter(|(key, _)| *key != "labels" && *key != "items").map(|(k, v)| (k.clone(), v.clone())),
        );
        let head = Value::Object(head).to_string();
        let items: Vec<String> = entries.iter().map(|entry| item_value(entry).to_string()).collect();
        format!("{},\"items\": [\n{}\n]}}\n", head.strip_suffix('}').unwrap_or(&head), items.join(",\n")).into_bytes()
    }
}

fn class_names(classes: &Value, path: &Path) -> Result<Vec<String>> {
    let names =
        classes.as_array().and_then(|names| names.iter().map(|name| name.as_str().map(str::to_owned)).collect());
    names.ok_or_else(|| Error::malformed(path, "`classes` must be an array of names"))
}

fn parse_item(item: Value, index: usize, path: &Path) -> Result<Entry> {
    let refuse = |reason: String| Error::malformed(path, format!("items[{index}]{reason}"));
    let Value::Object(mut item) = item else {
        return Err(refuse(" must be an object".into()));
    };
    let image = match item.shift_remove("image") {
        Some(Value::String(name)) => name,
        _ => return Err(refuse(".image must be the name of a file".into())),
    };
    let mask = match item.shift_remove("mask") {
        Some(Value::String(name)) => Some(name),
        None | Some(Value::Null) => None,
        Some(_) => return Err(refuse(".mask must be the name of a file".into())),
    };
    let mut numbers = [None; CAMERA_FIELDS.len()];
    for (field, number) in CAMERA_FIELDS.into_iter().zip(&mut numbers) {
        *number = match item.shift_remove(field) {
            None | Some(Value::Null) => None,
            Some(value) => {
                Some(value.as_f64().ok_or_else(|| refuse(format!(".{field} must be a number, not {value}")))?)
            }
        };
    }
    let [azimuth, elevation, roll, shift_x, shift_y, zoom] = numbers;
    let camera = match (azimuth, elevation) {
        (Some(azimuth_rad), Some(elevation_rad)) => Some(Camera {
            azimuth_rad,
            elevation_rad,
            roll_rad: roll.unwrap_or(0.0),
            shift_x: shift_x.unwrap_or(0.0),
            shift_y: shift_y.unwrap_or(0.0),
            zoom: zoom.unwrap_or(1.0),
            ..Camera::default()
        }),
        (None, None) => None,
        _ => return Err(refuse(" has one of azimuth and elevation; give both or neither".into())),
    };
    Ok(Entry { image, mask, camera, extra: item })
}

fn item_value(entry: &Entry) -> Value {
    let mut item = Map::new();
    item.insert("image".into(), entry.image.as_str().into());
    if let Some(mask) = &entry.mask {
        item.insert("mask".into(), mask.as_str().into());
    }
    if let Some(camera) = entry.camera {
        let values =
            [camera.azimuth_rad, camera.elevation_rad, camera.roll_rad, camera.shift_x, camera.shift_y, camera.zoom];
        let usual = [f64::NAN, f64::NAN, 0.0, 0.0, 0.0, 1.0];
        for ((field, value), usual) in CAMERA_FIELDS.into_iter().zip(values).zip(usual) {
            if value != usual {
                item.insert(field.into(), value.into());
            }
        }
    }
    item.extend(entry.extra.clone());
    Value::Object(item)
}

/// `[name, 25 floats]`: a row-major 4×4 camera-to-world matrix with OpenCV axes and a 3×3 intrinsic matrix in units
/// of the picture's width (EG3D).
fn parse_stylegan(label: &Value, index: usize, path: &Path, files: &Files) -> Result<Entry> {
    let refuse = |reason: &str| Error::malformed(path, format!("labels[{index}] {reason}"));
    let (image, numbers) = match label.as_array().map(Vec::as_slice) {
        Some([Value::String(image), Value::Array(numbers)]) => (image.clone(), numbers),
        _ => return Err(refuse("must be [name, 25 numbers]")),
    };
    let numbers: Option<Vec<f64>> = numbers.iter().map(Value::as_f64).collect();
    let numbers = numbers.and_then(|numbers| <[f64; 25]>::try_from(numbers).ok());
    let camera = numbers.and_then(|numbers| eg3d_camera(&numbers));
    let camera = camera.ok_or_else(|| refuse("must hold 16 numbers of a camera pose and 9 of its intrinsics"))?;
    let stem = image.rsplit_once('.').map_or(image.as_str(), |(stem, _)| stem);
    let masks = [format!("masks/{}.png", stem.strip_prefix("images/").unwrap_or(stem)), format!("masks/{stem}.png")];
    let mask = masks.into_iter().find(|name| files.contains(name));
    Ok(Entry { image, mask, camera: Some(camera), extra: Map::new() })
}

/// EG3D's camera as ours. Its world is scaled so that the camera stands at distance 1; the picture's offset is where
/// the world's origin appears, whether that comes from the principal point or from looking past the origin.
fn eg3d_camera(numbers: &[f64; 25]) -> Option<Camera> {
    let pose = |row: usize, column: usize| numbers[4 * row + column];
    let column = |index: usize| [pose(0, index), pose(1, index), pose(2, index)];
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let position = column(3);
    let distance = dot(position, position).sqrt();
    let back = position.map(|value| value / distance);
    let [focal_x, _, centre_x, _, focal_y, centre_y] = [16, 17, 18, 19, 20, 21].map(|at| numbers[at]);
    let azimuth_rad = back[0].atan2(back[2]);
    let elevation_rad = back[1].clamp(-1.0, 1.0).asin();
    let upright = Camera::at(azimuth_rad, elevation_rad).world_from_camera();
    let axis = |index: usize| upright.map(|row| row[index]);
    let roll_rad = dot(column(0), axis(1)).atan2(dot(column(0), axis(0)));
    // The origin in the camera's frame: x right, y down, z forward.
    let [x, y, z] = [0, 1, 2].map(|index| -dot(column(index), position));
    let camera = Camera {
        azimuth_rad,
        elevation_rad,
        roll_rad,
        shift_x: 2.0 * (focal_x * x / z + centre_x) - 1.0,
        shift_y: 1.0 - 2.0 * (focal_y * y / z + centre_y),
        zoom: 2.0 * focal_x * (0.5 * FIELD_OF_VIEW_RAD).tan(),
        ..Camera::default()
    };
    (distance > 0.0 && z > 0.0 && camera.parameters().iter().all(|value| value.is_finite())).then_some(camera)
}

/// What is wrong with a camera, if anything.
pub(super) fn camera_fault(camera: &Camera) -> Option<String> {
    use std::f64::consts::{FRAC_PI_2, PI};
    let bounds = [
        ("azimuth", camera.azimuth_rad, -PI, PI),
        ("elevation", camera.elevation_rad, -FRAC_PI_2, FRAC_PI_2),
        ("roll", camera.roll_rad, -PI, PI),
        ("shift_x", camera.shift_x, -2.0, 2.0),
        ("shift_y", camera.shift_y, -2.0, 2.0),
        ("zoom", camera.zoom, 0.05, 20.0),
    ];
    let fault = bounds.into_iter().find(|(_, value, low, high)| !(low..=high).contains(&value));
    fault.map(|(field, value, low, high)| {
        let unit = if matches!(field, "azimuth" | "elevation" | "roll") { "; angles are in radians" } else { "" };
        format!("{field} {value} is outside {low:.3}…{high:.3}{unit}")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eg3d_cameras_place_every_axis() {
        // Our camera written EG3D's way (axes y and z flipped, world 2.7 times as large) comes back.
        let camera = Camera { roll_rad: 0.2, shift_x: 0.1, shift_y: -0.05, zoom: 0.9, ..Camera::at(-0.4, 0.25) };
        let matrix = camera.world_from_camera();
        let focal = camera.zoom / (2.0 * (0.5 * FIELD_OF_VIEW_RAD).tan());
        let mut numbers = [0.0; 25];
        for (row, values) in matrix.iter().enumerate() {
            for (column, sign) in [1.0, -1.0, -1.0, 2.7].into_iter().enumerate() {
                numbers[4 * row + column] = sign * values[column];
            }
        }
        numbers[15] = 1.0;
        numbers[16..25].copy_from_slice(&[focal, 0.0, 0.55, 0.0, focal, 0.525, 0.0, 0.0, 1.0]);
        let found = eg3d_camera(&numbers).unwrap();
        for (found, expected) in found.parameters().iter().zip(camera.parameters()) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
        assert_eq!(eg3d_camera(&[0.0; 25]), None);
    }

    #[test]
    fn bad_angles_have_their_unit_named() {
        assert_eq!(camera_fault(&Camera::at(0.3, -0.2)), None);
        assert!(camera_fault(&Camera::at(20.0, 0.0)).unwrap().contains("radians"));
        assert!(camera_fault(&Camera { zoom: f64::NAN, ..Camera::default() }).unwrap().contains("zoom"));
    }
}
