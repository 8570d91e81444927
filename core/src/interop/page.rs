//! A portrait as one HTML page: pictures of the head from a grid of views, and a script that turns it with the mouse.
//!
//! Nothing is loaded from elsewhere. Each layer is one atlas, a picture of all views side by side: JPEG for what is
//! looked at, PNG for the label map, whose values must arrive as they were sent.

use std::path::Path;

use image::{GrayImage, Luma, RgbImage, imageops};
use serde_json::{Value, json};

use crate::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    error::{Error, Result},
    files,
    region::Region,
};

/// The page without its pictures.
const TEMPLATE: &str = include_str!("page/viewer.html");
/// What is replaced by the page's data.
const PLACE: &str = "/*PAGE*/null";
/// Label values are spread over a byte, so that a browser's colour management cannot make one into another.
const LABEL_STEP: u8 = 28;
const JPEG_QUALITY: u8 = 88;
/// Longest side of an atlas: what browsers decode on a phone, pixels.
const LARGEST_ATLAS: u32 = 8192;

/// The views of a page: every azimuth with every elevation.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// From the leftmost view to the rightmost, radians.
    pub azimuths_rad: Vec<f64>,
    /// From the lowest view to the highest, radians.
    pub elevations_rad: Vec<f64>,
}

impl Grid {
    /// `columns` by `rows` views, evenly over ±`azimuth_rad` and ±`elevation_rad`.
    ///
    /// # Errors
    /// [`Error::Config`] for fewer than 2 or more than 63 columns or rows.
    pub fn even(columns: usize, rows: usize, azimuth_rad: f64, elevation_rad: f64) -> Result<Self> {
        if !(2..=63).contains(&columns) || !(2..=63).contains(&rows) {
            return Err(Error::config("grid", format!("{columns}x{rows} views; give 2 to 63 each way")));
        }
        let spread = |count: usize, most: f64| {
            (0..count).map(|index| most * (2.0 * index as f64 / (count - 1) as f64 - 1.0)).collect()
        };
        Ok(Self { azimuths_rad: spread(columns, azimuth_rad), elevations_rad: spread(rows, elevation_rad) })
    }

    /// The cameras in the order of [`Page::frames`]: row by row, the lowest first.
    pub fn cameras(&self) -> Vec<Camera> {
        let row = |elevation: f64| self.azimuths_rad.iter().map(move |azimuth| Camera::at(*azimuth, elevation));
        self.elevations_rad.iter().flat_map(|elevation| row(*elevation)).collect()
    }
}

/// What one view shows; all pictures of a page are squares of one size.
#[derive(Clone, Debug)]
pub struct PageFrame {
    /// The portrait.
    pub portrait: RgbImage,
    /// Depth in grey.
    pub depth: RgbImage,
    /// Normals as colours.
    pub normal: RgbImage,
    /// The region of every pixel.
    pub labels: LabelMap,
}

/// A page under construction.
#[derive(Clone, Debug)]
pub struct Page {
    /// Shown above the controls.
    pub title: String,
    /// Where the frames were seen from.
    pub grid: Grid,
    /// One frame a camera, see [`Grid::cameras`].
    pub frames: Vec<PageFrame>,
}

impl Page {
    /// The page's text.
    ///
    /// # Errors
    /// [`Error::Shape`] if there is another number of frames than cameras or frames differ in size;
    /// [`Error::Config`] if all of them together are too large for browsers.
    pub fn html(&self) -> Result<String> {
        let (columns, rows) = (self.grid.azimuths_rad.len(), self.grid.elevations_rad.len());
        let side = self.frames.first().map_or(0, |frame| frame.portrait.width());
        if self.frames.len() != columns * rows || side == 0 {
            return Err(Error::shape("frames of a page", [columns * rows], &[self.frames.len()]));
        }
        if side.saturating_mul(columns.max(rows) as u32) > LARGEST_ATLAS {
            let most = LARGEST_ATLAS / side;
            return Err(Error::config("grid", format!("at most {most} views each way fit a page at {side} pixels")));
        }
        let jpeg = |pick: fn(&PageFrame) -> &RgbImage| -> Result<String> {
            let mut atlas = RgbImage::new(side * columns as u32, side * rows as u32);
            for (index, frame) in self.frames.iter().enumerate() {
                let picture = pick(frame);
                check_side(picture.dimensions(), side)?;
                imageops::replace(&mut atlas, picture, self.left(index, side), self.top(index, side));
            }
            Ok(data_url("image/jpeg", &picture::encode_jpeg(&atlas, JPEG_QUALITY)?))
        };
        let mut labels = GrayImage::new(side * columns as u32, side * rows as u32);
        for (index, frame) in self.frames.iter().enumerate() {
            check_side((frame.labels.width(), frame.labels.height()), side)?;
            let values = frame.labels.labels();
            let tile = GrayImage::from_fn(side, side, |x, y| {
                Luma([values.get((y * side + x) as usize).copied().unwrap_or(0) * LABEL_STEP])
            });
            imageops::replace(&mut labels, &tile, self.left(index, side), self.top(index, side));
        }
        let layer = |name: &str, label: &str| json!({ "name": name, "label": label });
        let regions: Vec<Value> =
            Region::ALL.iter().map(|region| json!({ "name": region.name(), "colour": region.colour() })).collect();
        let data = json!({
            "title": self.title,
            "side": side,
            "azimuths": self.grid.azimuths_rad,
            "elevations": self.grid.elevations_rad,
            "labelStep": LABEL_STEP,
            "regions": regions,
            "layers": [
                layer("portrait", "Portrait"),
                layer("regions", "Regions"),
                layer("depth", "Depth"),
                layer("normal", "Normals"),
            ],
            "atlases": {
                "portrait": jpeg(|frame| &frame.portrait)?,
                "depth": jpeg(|frame| &frame.depth)?,
                "normal": jpeg(|frame| &frame.normal)?,
                "labels": data_url("image/png", &picture::encode_indices(&labels)?),
            },
        });
        // A title cannot end the script it is in.
        Ok(TEMPLATE.replace(PLACE, &data.to_string().replace('<', "\\u003c")))
    }

    /// Writes the page, whole or not at all.
    ///
    /// # Errors
    /// Those of [`Self::html`]; [`Error::Io`] if it cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        files::write_atomically(path, self.html()?.as_bytes())
    }

    fn left(&self, index: usize, side: u32) -> i64 {
        (index % self.grid.azimuths_rad.len().max(1)) as i64 * i64::from(side)
    }

    fn top(&self, index: usize, side: u32) -> i64 {
        (index / self.grid.azimuths_rad.len().max(1)) as i64 * i64::from(side)
    }
}

fn check_side((width, height): (u32, u32), side: u32) -> Result<()> {
    if (width, height) == (side, side) {
        return Ok(());
    }
    Err(Error::shape("frame of a page", [side, side], &[width as usize, height as usize]))
}

fn data_url(kind: &str, bytes: &[u8]) -> String {
    format!("data:{kind};base64,{}", base64::encode(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page(title: &str) -> Page {
        let grid = Grid::even(3, 2, 0.6, 0.2).unwrap();
        let frames = (0..6u8).map(|index| {
            let flat = |value: u8| RgbImage::from_pixel(16, 16, image::Rgb([value; 3]));
            let labels = LabelMap::new(16, 16, vec![index; 256]).unwrap();
            PageFrame { portrait: flat(40 * index), depth: flat(9), normal: flat(200), labels }
        });
        Page { title: title.into(), grid, frames: frames.collect() }
    }

    fn data(html: &str) -> Value {
        let start = html.find("const page = ").unwrap() + "const page = ".len();
        let end = start + html[start..].find(";\n").unwrap();
        serde_json::from_str(&html[start..end]).unwrap()
    }

    #[test]
    fn every_view_lies_in_the_atlas_where_the_script_looks() {
        let page = page("Eileen");
        let cameras = page.grid.cameras();
        assert_eq!((cameras[0].azimuth_rad, cameras[0].elevation_rad), (-0.6, -0.2));
        assert_eq!((cameras[5].azimuth_rad, cameras[5].elevation_rad), (0.6, 0.2));
        let data = data(&page.html().unwrap());
        let url = data["atlases"]["labels"].as_str().unwrap();
        let png = base64::decode(url.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        let atlas = picture::decode_indices(&png, Path::new("atlas")).unwrap();
        assert_eq!(atlas.dimensions(), (48, 32));
        for index in 0..6u32 {
            let value = atlas.get_pixel(16 * (index % 3) + 8, 16 * (index / 3) + 8).0[0];
            assert_eq!(u32::from(value), 28 * index);
        }
    }

    #[test]
    fn a_title_cannot_break_out() {
        let html = page("</script><script>alert(1)</script>").html().unwrap();
        assert_eq!(html.matches("<script").count(), 1);
        assert_eq!(data(&html)["title"], "</script><script>alert(1)</script>");
        assert!(!html.contains(PLACE) && !html.contains("http"), "self-contained");
    }

    #[test]
    fn frames_that_do_not_fit_are_refused() {
        let mut wrong = page("x");
        wrong.frames.pop();
        assert!(wrong.html().is_err());
        let mut wrong = page("x");
        wrong.frames[3].depth = RgbImage::new(8, 16);
        assert!(wrong.html().is_err());
        assert!(Grid::even(1, 5, 0.6, 0.2).is_err() && Grid::even(5, 500, 0.6, 0.2).is_err());
    }
}
