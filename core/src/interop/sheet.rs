//! Contact sheets: pictures in a grid, with small labels and titles over the columns.

use std::{io::Cursor, path::Path};

use font8x8::{BASIC_FONTS, LATIN_FONTS, UnicodeFonts};
use image::{ImageFormat, Rgb, RgbImage, imageops};

use crate::{
    error::{Error, Result},
    files::write_atomically,
};

const GAP: u32 = 4;
const GLYPH: u32 = 8;
const MAX_PIXELS: u64 = 1 << 28;
const PAPER: Rgb<u8> = Rgb([24, 24, 28]);
const INK: Rgb<u8> = Rgb([226, 226, 232]);

/// A grid of pictures under construction. Cells are as large as the largest picture; smaller ones are centred.
#[derive(Clone, Debug, Default)]
pub struct Sheet {
    columns: usize,
    titles: Vec<String>,
    cells: Vec<(RgbImage, String)>,
}

impl Sheet {
    /// An empty sheet of so many columns (at least one).
    pub fn new(columns: usize) -> Self {
        Self { columns: columns.max(1), ..Self::default() }
    }

    /// An empty sheet with a column under each of these titles.
    pub fn with_titles(titles: impl IntoIterator<Item = impl Into<String>>) -> Self {
        let titles: Vec<String> = titles.into_iter().map(Into::into).collect();
        Self { titles: titles.clone(), ..Self::new(titles.len()) }
    }

    /// An empty sheet whose columns make `count` pictures a near square that is rather wide than high.
    pub fn near_square(count: usize) -> Self {
        Self::new((count as f64).sqrt().ceil() as usize)
    }

    /// Adds a picture after the last, rows first. A label that is empty takes no room if all are.
    #[must_use]
    pub fn push(mut self, picture: RgbImage, label: impl Into<String>) -> Self {
        self.cells.push((picture, label.into()));
        self
    }

    /// The sheet as a picture.
    ///
    /// # Errors
    /// [`Error::Config`] if the sheet has no pictures or would have more than 2^28 pixels.
    pub fn render(&self) -> Result<RgbImage> {
        let columns = self.columns.min(self.cells.len());
        if columns == 0 {
            return Err(Error::config("contact sheet", "there are no pictures to put on it"));
        }
        let rows = self.cells.len().div_ceil(columns);
        let widest = self.cells.iter().map(|(picture, _)| picture.width()).max().unwrap_or(0);
        let highest = self.cells.iter().map(|(picture, _)| picture.height()).max().unwrap_or(0);
        // Labels stay legible when a sheet of large pictures is scaled down.
        let scale = (widest / 192).clamp(1, 4);
        let label_height = if self.cells.iter().all(|(_, label)| label.is_empty()) { 0 } else { GLYPH * scale + GAP };
        let title_height = if self.titles.is_empty() { 0 } else { GLYPH * scale + 2 * GAP };
        let (cell_width, cell_height) = (widest + GAP, highest + label_height + GAP);
        let width = columns as u64 * u64::from(cell_width) + u64::from(GAP);
        let height = u64::from(title_height) + rows as u64 * u64::from(cell_height) + u64::from(GAP);
        if width.saturating_mul(height) > MAX_PIXELS {
            let reason = format!("{width} x {height} pixels are too many; ask for fewer or smaller pictures");
            return Err(Error::config("contact sheet", reason));
        }
        let mut sheet = RgbImage::from_pixel(width as u32, height as u32, PAPER);
        let room = (widest / (GLYPH * scale)) as usize;
        for (column, title) in self.titles.iter().take(columns).enumerate() {
            write_label(&mut sheet, title, room, scale, [GAP + column as u32 * cell_width, GAP]);
        }
        for (index, (picture, label)) in self.cells.iter().enumerate() {
            let left = GAP + (index % columns) as u32 * cell_width;
            let top = title_height + GAP + (index / columns) as u32 * cell_height;
            let (x, y) = (left + (widest - picture.width()) / 2, top + (highest - picture.height()) / 2);
            imageops::replace(&mut sheet, picture, x.into(), y.into());
            write_label(&mut sheet, label, room, scale, [left, top + highest + GAP / 2]);
        }
        Ok(sheet)
    }

    /// Writes the sheet as a PNG.
    ///
    /// # Errors
    /// Those of [`Self::render`]; [`Error::Io`] if it cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        save_png(&self.render()?, path.as_ref())
    }
}

/// Writes a picture as a PNG, whole or not at all.
pub(super) fn save_png(picture: &RgbImage, path: &Path) -> Result<()> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).map_err(|error| Error::malformed(path, error))?;
    write_atomically(path, &bytes.into_inner())
}

/// Writes at most `room` characters; a longer label ends in dots.
fn write_label(sheet: &mut RgbImage, label: &str, room: usize, scale: u32, [left, top]: [u32; 2]) {
    let mut characters: Vec<char> = label.chars().collect();
    if characters.len() > room {
        characters.truncate(room);
        characters.iter_mut().rev().take(2).for_each(|character| *character = '.');
    }
    for (index, character) in characters.into_iter().enumerate() {
        let glyph = BASIC_FONTS.get(character).or_else(|| LATIN_FONTS.get(character)).or_else(|| BASIC_FONTS.get('?'));
        for (row, bits) in glyph.unwrap_or_default().into_iter().enumerate() {
            for column in (0..GLYPH).filter(|column| bits >> column & 1 == 1) {
                let x = left + (index as u32 * GLYPH + column) * scale;
                let y = top + row as u32 * scale;
                for (dx, dy) in (0..scale).flat_map(|dy| (0..scale).map(move |dx| (dx, dy))) {
                    if let Some(pixel) = sheet.get_pixel_mut_checked(x + dx, y + dy) {
                        *pixel = INK;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(width: u32, height: u32, colour: [u8; 3]) -> RgbImage {
        RgbImage::from_pixel(width, height, Rgb(colour))
    }

    #[test]
    fn pictures_stand_in_rows_with_their_labels_below() {
        let sheet = Sheet::new(2)
            .push(plain(40, 30, [255, 0, 0]), "A")
            .push(plain(20, 30, [0, 255, 0]), "a label that is far too long")
            .push(plain(40, 30, [0, 0, 255]), "\u{6f22}")
            .render()
            .unwrap();
        assert_eq!(sheet.dimensions(), (4 + 2 * 44, 4 + 2 * (30 + 12 + 4)));
        assert_eq!(sheet.get_pixel(4, 4).0, [255, 0, 0]);
        assert_eq!(sheet.get_pixel(4 + 44 + 10, 4).0, [0, 255, 0], "a narrower picture is centred");
        assert_eq!(*sheet.get_pixel(4 + 44 + 9, 4), PAPER);
        assert_eq!(sheet.get_pixel(4, 4 + 46).0, [0, 0, 255]);
        let ink = |left: u32, top: u32, width: u32| {
            let places = (left..left + width).flat_map(|x| (top..top + GLYPH).map(move |y| (x, y)));
            places.filter(|&(x, y)| *sheet.get_pixel(x, y) == INK).count()
        };
        assert!(ink(4, 36, 8) > 10 && ink(12, 36, 32) == 0, "one letter");
        assert!(ink(48, 36, 40) > 20 && ink(88, 36, 4) == 0, "cut at the cell's width");
        assert!(ink(4, 82, 8) > 5, "a character without a glyph is marked");
    }

    #[test]
    fn titles_stand_over_their_columns() {
        let picture = || plain(40, 30, [255, 0, 0]);
        let sheet = Sheet::with_titles(["A", "B"]).push(picture(), "").push(picture(), "").push(picture(), "");
        let sheet = sheet.render().unwrap();
        let title = GLYPH + 2 * GAP;
        assert_eq!(sheet.dimensions(), (4 + 2 * 44, title + 4 + 2 * 34));
        for left in [4, 48] {
            let places = (left..left + 8).flat_map(|x| (4..4 + GLYPH).map(move |y| (x, y)));
            assert!(places.filter(|&(x, y)| *sheet.get_pixel(x, y) == INK).count() > 10, "one letter at {left}");
            assert_eq!(sheet.get_pixel(left, title + 4).0, [255, 0, 0]);
        }
    }

    #[test]
    fn sheets_are_written_as_png_and_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sheet.png");
        Sheet::near_square(3).push(plain(8, 8, [1, 2, 3]), "").save(&path).unwrap();
        let read = image::open(&path).unwrap().to_rgb8();
        assert_eq!((read.dimensions(), read.get_pixel(4, 4).0), ((16, 16), [1, 2, 3]));
        assert!(Sheet::new(3).save(&path).is_err());
        let wide = plain(70_000, 1, [0; 3]);
        let high = plain(1, 70_000, [0; 3]);
        assert!(Sheet::new(1).push(wide, "").push(high, "").render().is_err());
    }
}
