//! TensorBoard's event files: scalars and pictures of a training run.
//!
//! A file is a row of records — length, checksum, a protocol-buffer `Event`, checksum — as TensorFlow writes TFRecords. Only
//! the few fields of `Event` and `Summary` that are used here are declared, by their numbers in TensorFlow's
//! `event.proto` and `summary.proto`.

use std::{
    fs::{File, OpenOptions},
    io::Write as _,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use prost::Message;

use crate::error::{Error, Result};

/// `tensorflow.Event`.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    values: Vec<SummaryValue>,
}

/// `tensorflow.Summary.Value`.
#[derive(Clone, PartialEq, Message)]
struct SummaryValue {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
    #[prost(message, optional, tag = "4")]
    image: Option<SummaryImage>,
}

/// `tensorflow.Summary.Image`.
#[derive(Clone, PartialEq, Message)]
struct SummaryImage {
    #[prost(int32, tag = "1")]
    height: i32,
    #[prost(int32, tag = "2")]
    width: i32,
    /// 3 is RGB.
    #[prost(int32, tag = "3")]
    colorspace: i32,
    #[prost(bytes = "vec", tag = "4")]
    encoded: Vec<u8>,
}

/// An event file, written record by record so that TensorBoard can follow a run.
pub struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// A new file in `folder`, named as TensorBoard looks for it; a resumed run adds another one.
    pub fn create(folder: &Path) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, error))?;
        let path = folder.join(format!("events.out.tfevents.{:.6}.cnerf.{}", seconds(), std::process::id()));
        let file = OpenOptions::new().create_new(true).write(true).open(&path);
        let mut events = Self { file: file.map_err(|error| Error::io(&path, error))?, path };
        events.write(0, |event| event.file_version = Some("brain.Event:2".to_owned()))?;
        Ok(events)
    }

    /// Where the file lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Numbers of a step, each under its tag.
    pub fn scalars(&mut self, step: usize, values: impl IntoIterator<Item = (String, f64)>) -> Result<()> {
        let value = |(tag, value): (String, f64)| SummaryValue { tag, simple_value: Some(value as f32), image: None };
        let values = values.into_iter().map(value).collect();
        self.write(step, |event| event.summary = Some(Summary { values }))
    }

    /// A picture of a step, `width` × `height` pixels, as PNG bytes.
    pub fn png(&mut self, step: usize, tag: &str, [width, height]: [u32; 2], png: &[u8]) -> Result<()> {
        let image = SummaryImage { height: height as i32, width: width as i32, colorspace: 3, encoded: png.to_vec() };
        let value = SummaryValue { tag: tag.to_owned(), simple_value: None, image: Some(image) };
        self.write(step, |event| event.summary = Some(Summary { values: vec![value] }))
    }

    fn write(&mut self, step: usize, fill: impl FnOnce(&mut Event)) -> Result<()> {
        let mut event = Event { wall_time: seconds(), step: step as i64, ..Event::default() };
        fill(&mut event);
        // One write a record: a reader that follows the file never sees half of one's length.
        self.file.write_all(&record(&event.encode_to_vec())).map_err(|error| Error::io(&self.path, error))
    }
}

fn seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// A TFRecord around `data`.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(data.len() + 16);
    record.extend(length);
    record.extend(masked_checksum(&length).to_le_bytes());
    record.extend(data);
    record.extend(masked_checksum(data).to_le_bytes());
    record
}

/// CRC-32C, rotated and shifted so that the checksum of data that holds checksums stays a good one (TensorFlow).
fn masked_checksum(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The events of a file, its checksums verified.
    fn read(path: &Path) -> Vec<Event> {
        let bytes = std::fs::read(path).unwrap();
        let (mut rest, mut events) = (bytes.as_slice(), Vec::new());
        while !rest.is_empty() {
            let number = |range: std::ops::Range<usize>| u32::from_le_bytes(rest[range].try_into().unwrap());
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            assert_eq!(number(8..12), masked_checksum(&rest[..8]));
            let data = &rest[12..12 + length];
            assert_eq!(number(12 + length..16 + length), masked_checksum(data));
            events.push(Event::decode(data).unwrap());
            rest = &rest[16 + length..];
        }
        events
    }

    #[test]
    fn what_is_written_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = EventFile::create(folder.path()).unwrap();
        file.scalars(7, [("warmup/colour".to_owned(), 0.5), ("warmup/masks".to_owned(), 0.25)]).unwrap();
        file.png(8, "samples", [3, 2], b"png").unwrap();
        let events = read(file.path());
        assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
        assert_eq!(events[1].step, 7);
        let values = &events[1].summary.as_ref().unwrap().values;
        assert_eq!((values[0].tag.as_str(), values[0].simple_value), ("warmup/colour", Some(0.5)));
        let image = events[2].summary.as_ref().unwrap().values[0].image.clone().unwrap();
        assert_eq!((image.width, image.height, image.encoded.as_slice()), (3, 2, &b"png"[..]));
    }

    #[test]
    fn checksums_are_tensorflows() {
        // The header record of an event file TensorFlow wrote: length 24, then its masked checksum.
        assert_eq!(masked_checksum(&24u64.to_le_bytes()), 0x224b_7fa3);
    }
}
