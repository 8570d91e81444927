//! Damaged and hostile files by the thousand: whatever a user hands over, a reader takes it or refuses it in one line
//! that names the file. No panic, no hang, no memory beyond a bound.
//!
//! `CNERF_FUZZ=10000 cargo test … fuzz` reads as many mutated files per reader; the default is a few hundred. Every
//! file is a function of its reader's name and its number, so that a failure comes back.

use std::{
    io::{Cursor, Read as _, Write as _},
    panic::{self, AssertUnwindSafe},
    path::{Path, PathBuf},
    sync::{Mutex, mpsc},
    time::{Duration, Instant},
};

use candle_core::{Device, Tensor};
use cnerf_core::{
    camera::Camera,
    data::{
        cartoon::{RenderOptions, SynthOptions, synth},
        dataset::{Dataset, DatasetWriter, EncodedItem, PhotoFormat},
        import::{ImportConfig, MaskFormat, import},
        labels::LabelMap,
        picture,
    },
    interop::torch::read_checkpoint,
    model::{
        file::{self, ModelHeader},
        generator::Generator,
    },
    region::{Region, RegionSet},
    render::trajectory::Trajectory,
    rng::Stream,
};
use image::{DynamicImage, GrayImage, ImageFormat, RgbImage, RgbaImage};
use zip::{CompressionMethod, ZipArchive, ZipWriter, write::SimpleFileOptions};

use crate::{
    align::CropTransform,
    config::InvertConfig,
    edit::{self, Edit, Goal, Source},
    error::Result,
    inverter::{
        Inverter, Opened,
        tests::{small_generator, subject},
    },
    portrait::{Deltas, Metrics, ModelName, Portrait},
};

/// Files per reader unless CNERF_FUZZ says otherwise.
const FILES: u64 = 200;
/// No file may keep a reader this long, on a machine that does other work.
const LONGEST: Duration = Duration::from_secs(20);
const MIB: u64 = 1 << 20;

/// What a file is packed in. Half of all files are damaged inside and packed soundly, else checksums and lengths would
/// keep most damage from reaching the reader proper.
#[derive(Clone, Copy)]
enum Packing {
    None,
    /// A length, a JSON header, data.
    Safetensors,
    /// Entries; one is damaged.
    Zip,
    /// Chunks, each with its checksum.
    Png,
}

/// Reads bytes, as a file of the path given if it needs one.
type Read = Box<dyn Fn(&[u8], &Path) -> Result<()> + Send>;

/// A kind of file, and how it is read.
struct Reader {
    name: &'static str,
    seeds: Vec<(Vec<u8>, Packing)>,
    /// Resident memory that reading one file may add.
    most_memory: u64,
    read: Read,
}

/// What became of a file.
enum Outcome {
    Read,
    Refused(String),
    Panicked,
}

impl Reader {
    /// Reads mutated files; panics with all faults it found.
    fn hunt(self) {
        // Memory is the process's: one reader at a time.
        static TURN: Mutex<()> = Mutex::new(());
        let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let count = std::env::var("CNERF_FUZZ").ok().map_or(FILES, |count| count.parse().expect("CNERF_FUZZ=N"));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("fuzzed-{}", self.name));
        let (name, most_memory) = (self.name, self.most_memory);
        let stream = name.bytes().fold(0, |sum: u64, byte| sum.wrapping_mul(31).wrapping_add(u64::from(byte)));
        let (sender, receiver) = mpsc::channel();
        std::thread::spawn(move || {
            for number in 0..count {
                let mut random = Stream::new(1, &[stream, number]);
                let bytes = mutated(&self.seeds, &mut random);
                let before = start_peak();
                let began = Instant::now();
                let outcome = panic::catch_unwind(AssertUnwindSafe(|| (self.read)(&bytes, &path)));
                let (seconds, memory) = (began.elapsed().as_secs_f64(), peak().saturating_sub(before));
                let outcome = match outcome {
                    Ok(Ok(())) => Outcome::Read,
                    Ok(Err(error)) => Outcome::Refused(error.to_string()),
                    Err(_) => Outcome::Panicked,
                };
                if sender.send((number, outcome, seconds, memory, bytes)).is_err() {
                    return;
                }
            }
        });
        let mut faults = Vec::new();
        let (mut read, mut slowest, mut largest) = (0, (0.0, 0), (0, 0));
        for number in 0..count {
            let Ok((found, outcome, seconds, memory, bytes)) = receiver.recv_timeout(LONGEST) else {
                panic!("{name}: file {number} keeps the reader for more than {LONGEST:?}");
            };
            assert_eq!(found, number);
            slowest = if seconds > slowest.0 { (seconds, number) } else { slowest };
            largest = if memory > largest.0 { (memory, number) } else { largest };
            let fault = match outcome {
                Outcome::Panicked => Some("panicked".to_owned()),
                Outcome::Refused(text) if text.lines().count() != 1 => Some(format!("is refused in lines: {text:?}")),
                Outcome::Refused(text) if !text.contains("fuzzed") => Some(format!("is not named: {text}")),
                _ if memory > most_memory => Some(format!("took {} MiB", memory / MIB)),
                Outcome::Read => {
                    read += 1;
                    None
                }
                Outcome::Refused(_) => None,
            };
            if let Some(fault) = fault {
                let kept = std::env::temp_dir().join(format!("cnerf-fuzz-{name}-{number}"));
                std::fs::write(&kept, bytes).unwrap();
                faults.push(format!("{name}: file {number} {fault} (kept as {})", kept.display()));
            }
        }
        println!(
            "{name}: {count} files, {read} read; slowest {:.2} s (file {}); largest {} MiB (file {})",
            slowest.0,
            slowest.1,
            largest.0 / MIB,
            largest.1
        );
        assert!(faults.is_empty(), "{} of {count}\n{}", faults.len(), faults[..faults.len().min(20)].join("\n"));
        assert!(read < count, "{name}: damage is never refused");
    }
}

/// Makes the present memory the peak, and says how much it is; 0 where nobody tells.
fn start_peak() -> u64 {
    // Linux: 5 resets the peak of this process.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    peak()
}

/// The largest resident memory since [`start_peak`], bytes.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or_default();
    1024 * line.split_whitespace().next().and_then(|number| number.parse::<u64>().ok()).unwrap_or(0)
}

/// One of the seeds, damaged.
fn mutated(seeds: &[(Vec<u8>, Packing)], random: &mut Stream) -> Vec<u8> {
    let (seed, packing) = random.pick(seeds).unwrap();
    let other = random.pick(seeds).unwrap().0.clone();
    if random.chance(0.5)
        && let Some(bytes) = damaged_inside(seed, *packing, &other, random)
    {
        return bytes;
    }
    let mut bytes = seed.clone();
    damage(&mut bytes, &other, random);
    bytes
}

/// The file with sound packing around damaged contents; none for files without packing.
fn damaged_inside(seed: &[u8], packing: Packing, other: &[u8], random: &mut Stream) -> Option<Vec<u8>> {
    match packing {
        Packing::None => None,
        Packing::Safetensors => {
            let length = u64::from_le_bytes(seed.get(..8)?.try_into().ok()?) as usize;
            let mut header = seed.get(8..8 + length)?.to_vec();
            damage(&mut header, &[], random);
            Some([&(header.len() as u64).to_le_bytes(), header.as_slice(), seed.get(8 + length..)?].concat())
        }
        Packing::Zip => {
            let mut archive = ZipArchive::new(Cursor::new(seed)).ok()?;
            let target = random.below(archive.len());
            let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
            for index in 0..archive.len() {
                let mut entry = archive.by_index(index).ok()?;
                let mut content = Vec::new();
                entry.read_to_end(&mut content).ok()?;
                if index == target {
                    damage(&mut content, other, random);
                }
                let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
                writer.start_file(entry.name().ok()?.as_ref(), options).ok()?;
                writer.write_all(&content).ok()?;
            }
            Some(writer.finish().ok()?.into_inner())
        }
        Packing::Png => {
            let mut bytes = seed.to_vec();
            damage(&mut bytes, other, random);
            let mut at = 8;
            while let Some(length) = bytes.get(at..at + 4) {
                let length = u32::from_be_bytes(length.try_into().ok()?) as usize;
                let Some(end) = at.checked_add(8 + length).filter(|end| end + 4 <= bytes.len()) else { break };
                let sum = crc32(bytes.get(at + 4..end)?);
                bytes.get_mut(end..end + 4)?.copy_from_slice(&sum.to_be_bytes());
                at = end + 4;
            }
            Some(bytes)
        }
    }
}

/// The checksum of PNG's chunks.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| (sum >> 1) ^ (0xedb8_8320 & 0u32.wrapping_sub(sum & 1)))
    })
}

/// One injury in half of the cases, else up to four.
fn damage(bytes: &mut Vec<u8>, other: &[u8], random: &mut Stream) {
    let count = if random.chance(0.5) { 1 } else { 1 + random.below(4) };
    for _ in 0..count {
        injure(bytes, other, random);
    }
}

fn injure(bytes: &mut Vec<u8>, other: &[u8], random: &mut Stream) {
    const BYTES: [u8; 6] = [0, 1, 0x7f, 0x80, 0xfe, 0xff];
    const NUMBERS: [u64; 10] = [0, 1, 2, 0x7f, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, 1 << 40, u64::MAX];
    const TEXTS: [&str; 12] =
        ["0", "-1", "1e999", "NaN", "99999999999999999999", "4294967296", "0.5", "null", "[]", "\"\"", "{", "1e-300"];
    if bytes.is_empty() {
        bytes.extend(other.iter().take(64));
        return;
    }
    let length = bytes.len();
    // Headers stand at the start, directories at the end.
    let near = length.min(96);
    let at = match random.below(4) {
        0 => random.below(near),
        1 => length - 1 - random.below(near),
        _ => random.below(length),
    };
    let run = (1 + random.below(64)).min(length - at);
    match random.below(9) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = *random.pick(&BYTES).unwrap(),
        2 => bytes[at] = random.below(256) as u8,
        3 => bytes.truncate(at),
        4 => drop(bytes.drain(at..at + run)),
        5 => {
            let copy = bytes[at..at + run].to_vec();
            bytes.splice(at..at, copy);
        }
        6 => {
            // A length or an offset.
            let number = *random.pick(&NUMBERS).unwrap();
            let width = [1, 2, 4, 8][random.below(4)].min(length - at);
            let big = random.chance(0.5);
            for index in 0..width {
                let place = if big { width - 1 - index } else { index };
                bytes[at + place] = (number >> (8 * index)) as u8;
            }
        }
        7 => {
            // A number in a text.
            let digit = |byte: &u8| byte.is_ascii_digit();
            if let Some(start) = bytes[at..].iter().position(digit).map(|offset| at + offset) {
                let end = bytes[start..].iter().position(|byte| !digit(byte)).map_or(length, |offset| start + offset);
                bytes.splice(start..end, random.pick(&TEXTS).unwrap().bytes());
            }
        }
        _ => {
            // Another file's tail.
            let from = random.below(other.len().max(1)).min(other.len());
            bytes.truncate(at);
            bytes.extend(&other[from..]);
        }
    }
}

fn noise(width: u32, height: u32) -> RgbImage {
    let mut random = Stream::new(2, &[]);
    RgbImage::from_fn(width, height, |x, _| {
        image::Rgb([(x * 9) as u8, random.below(256) as u8, random.below(40) as u8])
    })
}

fn encoded(picture: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.into().write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

/// The file's own bytes under its path: for readers of files.
fn on_disk(bytes: &[u8], path: &Path) -> PathBuf {
    std::fs::write(path, bytes).unwrap();
    path.to_owned()
}

#[test]
fn pictures() {
    let photo = noise(24, 18);
    let mut jpeg = encoded(photo.clone(), ImageFormat::Jpeg);
    // An EXIF segment whose orientation is 6, after the start of the image.
    let exif = b"\xff\xe1\x00\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
    jpeg.splice(2..2, exif.iter().copied());
    assert_eq!(picture::decode(&jpeg, Path::new("upright.jpg")).unwrap().dimensions(), (18, 24));
    let deep = DynamicImage::from(photo.clone()).into_rgba16();
    let clear = RgbaImage::from_fn(9, 7, |x, y| image::Rgba([x as u8, y as u8, 0, (20 * x) as u8]));
    let mut seeds = vec![(jpeg, Packing::None)];
    for format in [ImageFormat::WebP, ImageFormat::Bmp, ImageFormat::Gif] {
        seeds.push((encoded(photo.clone(), format), Packing::None));
    }
    for picture in [photo.into(), DynamicImage::from(deep), clear.into(), GrayImage::new(20, 20).into()] {
        seeds.push((encoded(picture, ImageFormat::Png), Packing::Png));
    }
    let read = |bytes: &[u8], path: &Path| {
        let photo = picture::decode(bytes, path)?;
        assert!(photo.width() <= picture::MAX_SIDE && photo.height() <= picture::MAX_SIDE);
        Ok(())
    };
    Reader { name: "picture", seeds, most_memory: 1024 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn label_maps() {
    let map = LabelMap::new(20, 14, (0..280).map(|index| (index % 9) as u8).collect()).unwrap();
    let grey = encoded(GrayImage::from_fn(12, 12, |x, _| image::Luma([(x % 9) as u8])), ImageFormat::Png);
    let seeds = vec![(map.encode().unwrap(), Packing::Png), (grey, Packing::Png)];
    let scheme = cnerf_core::data::labels::LabelScheme::cnerf();
    let read = move |bytes: &[u8], path: &Path| Ok(LabelMap::decode(bytes, &scheme, path).map(drop)?);
    Reader { name: "label-map", seeds, most_memory: 640 * MIB, read: Box::new(read) }.hunt();
}

/// A small portrait with tuned weights and a history, and its model.
fn portrait() -> (Vec<u8>, Generator) {
    let generator = small_generator(3);
    let original = generator.parameters().snapshot().unwrap();
    let mut tuned = original.clone();
    let bias = &original["field.bias4"];
    tuned.insert("field.bias4".into(), (bias + 0.01).unwrap());
    let mut portrait = Portrait {
        model: ModelName { name: "small".into(), hash: generator.hash().unwrap() },
        source: "somebody.jpg".into(),
        crop: Some(CropTransform { centre_x: 1.5, centre_y: 2.0, half_side: 3.0, angle_rad: 0.1 }),
        codes: generator.codes_from_seed(4, 1.0).unwrap().squeeze(0).unwrap(),
        upsampler_code: None,
        tint: Some(Tensor::full(0.1f32, (9, 3), &Device::Cpu).unwrap()),
        camera: Camera::at(0.1, 0.0),
        deltas: Deltas::between(&original, &tuned).unwrap(),
        noise: Vec::new(),
        thumbnail: RgbImage::new(8, 8),
        config: InvertConfig::default(),
        metrics: Metrics::default(),
        history: Vec::new(),
    };
    let hair = RegionSet::from(Region::Hair);
    let edit = Edit { regions: hair, aspect: cnerf_core::codes::Aspect::Both, source: Source::Seed(2), amount: 0.7 };
    let goal = Goal::of(&edit.source, &generator, None, None).unwrap();
    edit::apply(&mut portrait, Path::new("somebody"), &generator, &[(edit, goal)]).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("somebody.cnerf");
    portrait.save(&path).unwrap();
    (std::fs::read(path).unwrap(), generator)
}

#[test]
fn portraits() {
    let (bytes, generator) = portrait();
    let read = move |bytes: &[u8], path: &Path| {
        let portrait = Portrait::parse(path, bytes)?;
        let opened = Opened::new(&portrait, path, &generator)?;
        opened.picture(&portrait.camera)?;
        let mut last = portrait;
        while !last.history.is_empty() {
            last.undo(path)?;
        }
        Ok(())
    };
    let seeds = vec![(bytes, Packing::Safetensors)];
    Reader { name: "portrait", seeds, most_memory: 256 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn models() {
    let generator = small_generator(3);
    let header = ModelHeader {
        version: 1,
        config: generator.config().clone(),
        preset: "tiny".into(),
        provenance: "made up".into(),
        hash: String::new(),
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    file::write_model(&path, &generator.parameters().snapshot().unwrap(), &header).unwrap();
    let read = |bytes: &[u8], path: &Path| {
        let generator = Generator::from_bytes(path, &resealed(bytes, path), &Device::Cpu)?;
        let codes = generator.codes_from_seed(1, 1.0)?;
        let view = Camera::parameter_tensor(&[Camera::default()], &Device::Cpu)?;
        crate::pivot::whole_picture(&generator, &codes, None, &view, false)?;
        Ok(())
    };
    let seeds = vec![(std::fs::read(path).unwrap(), Packing::Safetensors)];
    Reader { name: "model", seeds, most_memory: 512 * MIB, read: Box::new(read) }.hunt();
}

/// A model whose hash is right again, if it can be read at all: else the hash would refuse every damaged weight.
fn resealed(bytes: &[u8], path: &Path) -> Vec<u8> {
    const KEY: &str = "cnerf-model";
    let sealed = || {
        let (tensors, metadata) = file::parse_safetensors(path, bytes).ok()?;
        let mut header: serde_json::Value = serde_json::from_str(metadata.get(KEY)?).ok()?;
        header.as_object_mut()?.insert("hash".into(), file::hash(&tensors).ok()?.into());
        file::safetensors_bytes(path, &tensors, &[(KEY, header.to_string())]).ok()
    };
    sealed().unwrap_or_else(|| bytes.to_vec())
}

#[test]
fn stopped_inversions() {
    let generator = small_generator(3);
    let subject = subject(&generator, true);
    let config = InvertConfig { pivot_steps: Some(4), tune_steps: Some(3), ..InvertConfig::default() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stopped.part");
    let mut inverter = Inverter::new(&generator, "small", subject.clone(), config.clone(), None).unwrap();
    (0..7).for_each(|_| drop(inverter.step().unwrap()));
    inverter.save(&path).unwrap();
    drop(inverter);
    let read = move |bytes: &[u8], path: &Path| {
        let mut inverter = Inverter::new(&generator, "small", subject.clone(), config.clone(), None)?;
        inverter.resume(&on_disk(bytes, path))
    };
    let seeds = vec![(std::fs::read(&path).unwrap(), Packing::Safetensors)];
    Reader { name: "checkpoint-of-inversion", seeds, most_memory: 256 * MIB, read: Box::new(read) }.hunt();
}

/// Two small cartoon heads as a data set.
fn dataset(path: &Path) {
    let options = SynthOptions { count: 2, size: 32, ..SynthOptions::default() };
    let mut writer = DatasetWriter::create(path, false).unwrap();
    for item in synth(1, options, RenderOptions::default()).unwrap() {
        let rgb = RgbImage::from_raw(32, 32, item.picture.rgb.clone()).unwrap();
        let labels = LabelMap::new(32, 32, item.picture.labels.clone()).unwrap();
        writer.add(EncodedItem::new(&rgb, Some(&labels), Some(item.camera), PhotoFormat::Png).unwrap()).unwrap();
    }
    writer.finish().unwrap();
}

fn read_dataset(path: &Path) -> Result<()> {
    let dataset = Dataset::open(path)?;
    for index in 0..dataset.len().min(4) {
        dataset.item(index)?;
    }
    Ok(())
}

#[test]
fn zips() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("set.zip");
    dataset(&path);
    let seeds = vec![(std::fs::read(path).unwrap(), Packing::Zip)];
    let read = |bytes: &[u8], path: &Path| read_dataset(&on_disk(bytes, &path.with_extension("zip")));
    Reader { name: "zip", seeds, most_memory: 1024 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn dataset_indices() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("fuzzed-set"));
    let index = folder.path().join("fuzzed-set/dataset.json");
    let stylegan =
        br#"{"labels": [["images/00000.png", [1,0,0,0, 0,1,0,0, 0,0,1,2.7, 0,0,0,1, 4.26,0,0.5, 0,4.26,0.5, 0,0,1]]]}"#;
    let seeds = vec![(std::fs::read(&index).unwrap(), Packing::None), (stylegan.to_vec(), Packing::None)];
    let read = move |bytes: &[u8], _: &Path| {
        on_disk(bytes, &index);
        read_dataset(&folder.path().join("fuzzed-set"))
    };
    Reader { name: "dataset-json", seeds, most_memory: 256 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn camera_paths() {
    let text = br#"[{"azimuth": -0.3, "elevation": 0.0}, {"azimuth": 0.3, "elevation": 0.1, "roll": 0.02, "zoom": 1.5,
        "shift_x": 0.1, "shift_y": -0.2, "field_of_view": 0.21}]"#;
    let read = |bytes: &[u8], path: &Path| {
        let path = on_disk(bytes, &path.with_extension("json"));
        for camera in Trajectory::File(path).cameras(Some(7))? {
            let finite = camera.world_from_camera().iter().flatten().all(|value| value.is_finite());
            assert!(finite, "{camera:?}");
        }
        Ok(())
    };
    let seeds = vec![(text.to_vec(), Packing::None)];
    Reader { name: "camera-path", seeds, most_memory: 64 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn checkpoints() {
    let reference = std::env::var_os("CNERF_REFERENCE")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/reference"), PathBuf::from);
    let Ok(seed) = std::fs::read(reference.join("tiny_s0_vol_renderer.pt")) else {
        println!("skipped: {} is not there", reference.display());
        return;
    };
    let read = |bytes: &[u8], path: &Path| {
        let checkpoint = read_checkpoint(on_disk(bytes, &path.with_extension("pt")))?;
        for (_, tensor) in checkpoint.flatten() {
            tensor.flatten_all()?;
        }
        Ok(())
    };
    let seeds = vec![(seed, Packing::Zip)];
    Reader { name: "checkpoint", seeds, most_memory: 256 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn arrays() {
    let array = |shape: &str, kind: &str, data: &[u8]| {
        let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
        let length = (header.len() as u16).to_le_bytes();
        [b"\x93NUMPY\x01\x00".as_slice(), &length, header.as_bytes(), data].concat()
    };
    let floats: Vec<u8> = (0..9 * 36).flat_map(|index| f32::from(u8::from(index % 9 == 0)).to_le_bytes()).collect();
    let seeds = vec![
        (array("9, 6, 6", "<f4", &floats), Packing::None),
        (array("6, 6", "|u1", &[1; 36]), Packing::None),
        (array("9, 6, 6", "|b1", &[1; 324]), Packing::None),
    ];
    let folder = tempfile::tempdir().unwrap();
    let (images, masks) = (folder.path().join("photos"), folder.path().join("fuzzed-masks"));
    std::fs::create_dir_all(&images).unwrap();
    std::fs::create_dir_all(&masks).unwrap();
    picture::write(&images.join("00000.png"), &noise(6, 6)).unwrap();
    let format = MaskFormat::AuthorsNpy;
    let config =
        ImportConfig { images, masks, format, classes: Vec::new(), cameras: None, resolution: None, jpeg: None };
    let read = move |bytes: &[u8], _: &Path| {
        on_disk(bytes, &config.masks.join("00000.npy"));
        let mut writer = DatasetWriter::create(&folder.path().join("out.zip"), true)?;
        import(&config, &mut writer, &|_, _| {})?;
        Ok(writer.finish()?)
    };
    Reader { name: "array", seeds, most_memory: 512 * MIB, read: Box::new(read) }.hunt();
}

#[cfg(feature = "onnx")]
#[test]
fn parsers() {
    use crate::parser::{OnnxParser, PixelScale, RegionParser as _, identity_network};
    let seeds = [false, true].map(|labels| (identity_network(&[1, 3, 16, 24], labels), Packing::None)).to_vec();
    let read = |bytes: &[u8], path: &Path| {
        let scheme = cnerf_core::data::labels::LabelScheme::from_class_names(&["hair", "skin", "background"])?;
        let parser = OnnxParser::load(&on_disk(bytes, &path.with_extension("onnx")), scheme, PixelScale::Symmetric)?;
        parser.parse(&noise(16, 16)).map(drop)
    };
    Reader { name: "onnx", seeds, most_memory: 256 * MIB, read: Box::new(read) }.hunt();
}

#[test]
fn the_same_number_is_the_same_file() {
    let seeds = vec![(b"{\"a\": 12}".to_vec(), Packing::None)];
    let files = |number| mutated(&seeds, &mut Stream::new(1, &[7, number]));
    assert_eq!(files(3), files(3));
    let different = (0..50).map(files).collect::<std::collections::BTreeSet<_>>().len();
    assert!(different > 40, "{different}");
    // The checksum of PNG's empty last chunk is known.
    assert_eq!(crc32(b"IEND"), 0xae42_6082);
}
