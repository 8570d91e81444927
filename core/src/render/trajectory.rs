//! Paths of the camera: what the frames of a multi-view sequence look from.

use std::{
    f64::consts::{FRAC_PI_2, TAU},
    fmt,
    io::Read,
    path::{Path, PathBuf},
    str::FromStr,
};

use serde::{Deserialize, Serialize};

use crate::{
    camera::{Camera, FIELD_OF_VIEW_RAD},
    error::{Error, Result},
};

/// The most frames a trajectory may have.
pub const MAX_FRAMES: usize = 10_000;
/// Largest azimuth of [`Trajectory::Orbit`] and [`Trajectory::Sweep`], radians: where training has seen faces well.
pub const AZIMUTH_RANGE_RAD: f64 = 0.4;
/// Largest elevation of [`Trajectory::Orbit`], radians.
pub const ELEVATION_RANGE_RAD: f64 = 0.15;

const DEFAULT_FRAMES: usize = 48;
const MAX_FILE_BYTES: u64 = 16 << 20;

/// A path of the camera. On the command line and in files: `orbit`, `sweep`, `front` or the name of a `.json` file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Trajectory {
    /// A closed loop: azimuth 0.4 cos, elevation 0.15 sin. The frame after the last would be the first.
    #[default]
    Orbit,
    /// From azimuth -0.4 to 0.4 at elevation 0: first seen from the picture's left, last from its right.
    Sweep,
    /// The frontal view in every frame.
    Front,
    /// The cameras of a file, see [`Trajectory::cameras`].
    File(PathBuf),
}

impl Trajectory {
    /// The camera of every frame.
    ///
    /// Without `frames`: 48 of an orbit or sweep, 1 of the front, as many as the file has.
    ///
    /// A file is a JSON list of objects, each a camera: `azimuth` and `elevation` in radians, and optionally `roll`
    /// (radians, 0), `shift_x` and `shift_y` (half picture sizes, 0), `zoom` (1) and `field_of_view` (full angle,
    /// radians, 12 degrees): `[{"azimuth": -0.3, "elevation": 0.0}, {"azimuth": 0.3, "elevation": 0.1, "zoom": 1.5}]`.
    /// When another number of frames is asked for than the file has, its cameras are key frames, spaced evenly from
    /// the first frame to the last, and those between are interpolated linearly (zoom by its logarithm).
    ///
    /// # Errors
    /// [`Error::Config`] for 0 or more than 10,000 frames; [`Error::Io`] and [`Error::Malformed`] of the file: unknown
    /// fields, values that are not finite or out of range, no cameras or too many.
    pub fn cameras(&self, frames: Option<usize>) -> Result<Vec<Camera>> {
        let keys = if let Self::File(path) = self { read_cameras(path)? } else { Vec::new() };
        let frames = frames.unwrap_or(match self {
            Self::Orbit | Self::Sweep => DEFAULT_FRAMES,
            Self::Front => 1,
            Self::File(_) => keys.len(),
        });
        if !(1..=MAX_FRAMES).contains(&frames) {
            return Err(Error::config("frames", format!("{frames} is not between 1 and {MAX_FRAMES}")));
        }
        let from_start_to_end = |frame: usize| if frames > 1 { frame as f64 / (frames - 1) as f64 } else { 0.5 };
        Ok((0..frames)
            .map(|frame| match self {
                Self::Orbit => {
                    let (sin, cos) = (TAU * frame as f64 / frames as f64).sin_cos();
                    Camera::at(AZIMUTH_RANGE_RAD * cos, ELEVATION_RANGE_RAD * sin)
                }
                Self::Sweep => Camera::at(AZIMUTH_RANGE_RAD * (2.0 * from_start_to_end(frame) - 1.0), 0.0),
                Self::Front => Camera::default(),
                Self::File(_) if frames == keys.len() => keys.get(frame).copied().unwrap_or_default(),
                Self::File(_) if frames == 1 => keys.first().copied().unwrap_or_default(),
                Self::File(_) => between(&keys, from_start_to_end(frame)),
            })
            .collect())
    }
}

impl FromStr for Trajectory {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "orbit" => Ok(Self::Orbit),
            "sweep" => Ok(Self::Sweep),
            "front" => Ok(Self::Front),
            path if path.to_ascii_lowercase().ends_with(".json") => Ok(Self::File(path.into())),
            other => {
                let reason =
                    format!("unknown trajectory `{other}`; use orbit, sweep, front or a .json file of cameras");
                Err(Error::config("trajectory", reason))
            }
        }
    }
}

impl fmt::Display for Trajectory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Orbit => f.write_str("orbit"),
            Self::Sweep => f.write_str("sweep"),
            Self::Front => f.write_str("front"),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

impl TryFrom<String> for Trajectory {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<Trajectory> for String {
    fn from(trajectory: Trajectory) -> Self {
        trajectory.to_string()
    }
}

/// A camera as files write it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileCamera {
    azimuth: f64,
    elevation: f64,
    #[serde(default)]
    roll: f64,
    #[serde(default)]
    shift_x: f64,
    #[serde(default)]
    shift_y: f64,
    #[serde(default = "one")]
    zoom: f64,
    #[serde(default = "default_field_of_view")]
    field_of_view: f64,
}

fn one() -> f64 {
    1.0
}

fn default_field_of_view() -> f64 {
    FIELD_OF_VIEW_RAD
}

impl FileCamera {
    /// The camera, or the name of the field that is out of range and its range.
    fn camera(&self) -> Result<Camera, String> {
        for (name, value, low, high) in [
            ("azimuth", self.azimuth, -TAU, TAU),
            ("elevation", self.elevation, -FRAC_PI_2, FRAC_PI_2),
            ("roll", self.roll, -TAU, TAU),
            ("shift_x", self.shift_x, -10.0, 10.0),
            ("shift_y", self.shift_y, -10.0, 10.0),
            ("zoom", self.zoom, 0.01, 100.0),
            ("field_of_view", self.field_of_view, 0.001, 2.0),
        ] {
            if !(low..=high).contains(&value) {
                let unit = if name.starts_with("shift") || name == "zoom" { "" } else { " radians" };
                return Err(format!("`{name}` {value} is not between {low:.3} and {high:.3}{unit}"));
            }
        }
        Ok(Camera {
            azimuth_rad: self.azimuth,
            elevation_rad: self.elevation,
            roll_rad: self.roll,
            shift_x: self.shift_x,
            shift_y: self.shift_y,
            zoom: self.zoom,
            field_of_view_rad: self.field_of_view,
        })
    }
}

fn read_cameras(path: &Path) -> Result<Vec<Camera>> {
    let failed = |error| Error::io(path, error);
    let file = std::fs::File::open(path).map_err(failed)?;
    let mut text = Vec::new();
    file.take(MAX_FILE_BYTES + 1).read_to_end(&mut text).map_err(failed)?;
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(Error::malformed(path, format!("larger than {MAX_FILE_BYTES} bytes: not a list of cameras")));
    }
    let read: Vec<FileCamera> = serde_json::from_slice(&text).map_err(|error| {
        let remedy = r#"write a list like [{"azimuth": 0.2, "elevation": 0.0}]"#;
        Error::malformed(path, format!("{error}; {remedy}"))
    })?;
    if !(1..=MAX_FRAMES).contains(&read.len()) {
        return Err(Error::malformed(path, format!("has {} cameras; 1 to {MAX_FRAMES} are possible", read.len())));
    }
    let camera = |(index, camera): (usize, &FileCamera)| {
        camera.camera().map_err(|reason| Error::malformed(path, format!("camera {index}: {reason}")))
    };
    read.iter().enumerate().map(camera).collect()
}

/// The camera at `position` in [0, 1] along key frames that are spaced evenly.
fn between(keys: &[Camera], position: f64) -> Camera {
    let along = position * keys.len().saturating_sub(1) as f64;
    let (before, part) = (along.floor(), along.fract());
    let key = |index: usize| keys.get(index).or(keys.last()).copied().unwrap_or_default();
    let (a, b) = (key(before as usize), key(before as usize + 1));
    let mix = |a: f64, b: f64| a + part * (b - a);
    let (left, right) = (a.parameters(), b.parameters());
    Camera {
        field_of_view_rad: mix(a.field_of_view_rad, b.field_of_view_rad),
        ..Camera::from_parameters(std::array::from_fn(|index| mix(left[index], right[index])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> (tempfile::TempDir, Trajectory) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("path.json");
        std::fs::write(&path, text).unwrap();
        (folder, Trajectory::File(path))
    }

    #[test]
    fn an_orbit_is_a_closed_loop_within_its_ranges() {
        let cameras = Trajectory::Orbit.cameras(Some(60)).unwrap();
        assert_eq!(cameras.len(), 60);
        assert_eq!((cameras[0].azimuth_rad, cameras[0].elevation_rad), (0.4, 0.0));
        let step = |a: &Camera, b: &Camera| (a.azimuth_rad - b.azimuth_rad).hypot(a.elevation_rad - b.elevation_rad);
        let longest = cameras.windows(2).map(|pair| step(&pair[0], &pair[1])).fold(0.0, f64::max);
        assert!(step(&cameras[59], &cameras[0]) <= longest, "no jump where the loop closes");
        assert!((cameras[15].elevation_rad - 0.15).abs() < 1e-12 && (cameras[30].azimuth_rad + 0.4).abs() < 1e-12);
    }

    #[test]
    fn sweeps_go_from_left_to_right_and_the_front_stays() {
        let azimuths: Vec<f64> =
            Trajectory::Sweep.cameras(Some(5)).unwrap().iter().map(|camera| camera.azimuth_rad).collect();
        for (azimuth, expected) in azimuths.iter().zip([-0.4, -0.2, 0.0, 0.2, 0.4]) {
            assert!((azimuth - expected).abs() < 1e-12);
        }
        assert_eq!(Trajectory::Sweep.cameras(Some(1)).unwrap()[0].azimuth_rad, 0.0);
        assert_eq!(Trajectory::Front.cameras(Some(3)).unwrap(), [Camera::default(); 3]);
        assert_eq!(Trajectory::Front.cameras(None).unwrap().len(), 1);
        assert!(Trajectory::Front.cameras(Some(0)).is_err());
        assert!(Trajectory::Front.cameras(Some(MAX_FRAMES + 1)).unwrap_err().to_string().starts_with("frames: 10001"));
    }

    #[test]
    fn files_give_their_cameras_or_a_path_between_them() {
        let (_folder, path) =
            file(r#"[{"azimuth": -0.2, "elevation": 0}, {"azimuth": 0.2, "elevation": 0.1, "zoom": 4, "roll": 0.5}]"#);
        let exact = path.cameras(None).unwrap();
        assert_eq!(exact[1], Camera { zoom: 4.0, roll_rad: 0.5, ..Camera::at(0.2, 0.1) });
        let path = path.cameras(Some(5)).unwrap();
        assert!((path[2].azimuth_rad).abs() < 1e-12 && (path[2].zoom - 2.0).abs() < 1e-12);
        assert!((path[4].azimuth_rad - 0.2).abs() < 1e-12 && (path[4].zoom - 4.0).abs() < 1e-12);
    }

    #[test]
    fn faulty_files_say_what_is_wrong() {
        for (text, says) in [
            ("[]", "has 0 cameras"),
            ("{}", "write a list like"),
            (r#"[{"azimuth": 0}]"#, "missing field `elevation`"),
            (r#"[{"azimuth": 0, "elevation": 0, "rol": 1}]"#, "unknown field `rol`"),
            (r#"[{"azimuth": 0, "elevation": 3}]"#, "camera 0: `elevation` 3 is not between"),
            (r#"[{"azimuth": 1e999, "elevation": 0}]"#, "out of range"),
            (r#"[{"azimuth": 0, "elevation": 0, "zoom": 0}]"#, "`zoom` 0 is not"),
        ] {
            let (_folder, trajectory) = file(text);
            let error = trajectory.cameras(None).unwrap_err().to_string();
            assert!(error.contains(says) && !error.contains('\n'), "{text}: {error}");
        }
        let many = format!("[{}]", vec![r#"{"azimuth":0,"elevation":0}"#; MAX_FRAMES + 1].join(","));
        assert!(file(&many).1.cameras(None).is_err());
    }

    #[test]
    fn names_round_trip() {
        for name in ["orbit", "sweep", "front", "shots/a.json"] {
            assert_eq!(name.parse::<Trajectory>().unwrap().to_string(), name);
        }
        assert!("orbitt".parse::<Trajectory>().unwrap_err().to_string().contains("unknown trajectory `orbitt`"));
    }
}
