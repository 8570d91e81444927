use cnerf_core::{codes::Aspect, region::Region, rng::Stream};

use super::*;
use crate::edit::{Change, Source};

fn sample() -> (Portrait, BTreeMap<String, Tensor>) {
    let mut random = Stream::new(5, &[]);
    let mut draw = |shape: &[usize]| random.normal_tensor(shape, &Device::Cpu).unwrap();
    let original = BTreeMap::from([("field.weight4".to_owned(), draw(&[9, 4, 4])), ("still".to_owned(), draw(&[3]))]);
    let mut tuned = original.clone();
    tuned.insert("field.weight4".into(), (&original["field.weight4"] + (draw(&[9, 4, 4]) * 1e-5).unwrap()).unwrap());
    let codes = draw(&[9, 2, 6]);
    let record = EditRecord {
        edit: Edit { regions: Region::Hair.into(), aspect: Aspect::Texture, source: Source::Seed(3), amount: 0.5 },
        change: Change { inside_change: 0.1, outside_change: 0.01, depth_change: 0.0 },
    };
    let undo =
        Undo { codes: draw(&[9, 2, 6]), upsampler_code: None, tint: Some(draw(&[9, 3]).clamp(-1.0, 1.0).unwrap()) };
    let portrait = Portrait {
        model: ModelName { name: "portrait".into(), hash: "ab".repeat(32) },
        source: "photo.jpg".into(),
        crop: Some(CropTransform { centre_x: 1.5, centre_y: 2.0, half_side: 3.0, angle_rad: 0.1 }),
        codes,
        upsampler_code: Some(draw(&[6])),
        tint: Some((draw(&[9, 3]) * 0.1).unwrap()),
        camera: Camera::at(0.2, -0.1),
        deltas: Deltas::between(&original, &tuned).unwrap(),
        noise: vec![draw(&[1, 1, 2, 2])],
        thumbnail: RgbImage::from_pixel(5, 4, image::Rgb([9, 8, 7])),
        config: InvertConfig::default(),
        metrics: Metrics { psnr: 27.5, lpips: Some(0.1), ..Metrics::default() },
        history: vec![(record, undo)],
    };
    (portrait, original)
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_dtype(DType::F32).unwrap().to_vec1().unwrap()
}

fn saved(portrait: &Portrait) -> (tempfile::TempDir, PathBuf, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("somebody.cnerf");
    portrait.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    (folder, path, bytes)
}

#[test]
fn portraits_round_trip() {
    let (portrait, original) = sample();
    let (folder, path, bytes) = saved(&portrait);
    let read = Portrait::load(&path).unwrap();
    assert_eq!(values(&read.codes), values(&portrait.codes));
    assert_eq!(values(read.upsampler_code.as_ref().unwrap()), values(portrait.upsampler_code.as_ref().unwrap()));
    assert_eq!(values(read.tint.as_ref().unwrap()), values(portrait.tint.as_ref().unwrap()));
    assert_eq!((read.camera, read.crop, &read.thumbnail), (portrait.camera, portrait.crop, &portrait.thumbnail));
    assert_eq!((&read.config, &read.metrics, &read.model), (&portrait.config, &portrait.metrics, &portrait.model));
    assert_eq!(read.history[0].0, portrait.history[0].0);
    assert_eq!(values(&read.noise[0]), values(&portrait.noise[0]));
    let (before, after) = (portrait.deltas.applied(&original).unwrap(), read.deltas.applied(&original).unwrap());
    assert_eq!(before.len(), 1, "weights that did not change are not kept");
    assert_eq!(values(&before["field.weight4"]), values(&after["field.weight4"]));
    // The same portrait is the same bytes, and nothing but the file is left behind.
    read.save(&path).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), bytes);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn small_deltas_keep_eleven_bits() {
    let zero = Tensor::zeros(200, DType::F32, &Device::Cpu).unwrap();
    let delta = (Stream::new(1, &[]).normal_tensor(&[200], &Device::Cpu).unwrap() * 3e-7).unwrap();
    let original = BTreeMap::from([("w".to_owned(), zero)]);
    let deltas = Deltas::between(&original, &BTreeMap::from([("w".to_owned(), delta.clone())])).unwrap();
    let largest = values(&delta).into_iter().fold(0.0f32, |largest, value| largest.max(value.abs()));
    for (found, expected) in values(&deltas.applied(&original).unwrap()["w"]).iter().zip(values(&delta)) {
        assert!((found - expected).abs() <= 5e-4 * expected.abs() + 1e-7 * largest, "{found} {expected}");
    }
}

#[test]
fn another_model_is_refused_by_name_with_the_remedy() {
    let (portrait, _) = sample();
    portrait.check_model(Path::new("a.cnerf"), &"ab".repeat(32)).unwrap();
    let error = portrait.check_model(Path::new("a.cnerf"), &"cd".repeat(32)).unwrap_err().to_string();
    for part in ["a.cnerf", "`portrait`", "abababababab", "cdcdcdcdcdcd", "--model"] {
        assert!(error.contains(part), "{error}");
    }
    let other = BTreeMap::from([("field.weight4".to_owned(), Tensor::zeros(3, DType::F32, &Device::Cpu).unwrap())]);
    assert!(portrait.deltas.applied(&other).unwrap_err().to_string().contains("field.weight4"));
}

#[test]
fn undo_gives_back_the_codes_before() {
    let (mut portrait, _) = sample();
    let before = values(&portrait.history[0].1.codes);
    portrait.undo(Path::new("a.cnerf")).unwrap();
    assert_eq!(values(&portrait.codes), before);
    assert!(matches!(portrait.undo(Path::new("a.cnerf")), Err(Error::NothingToUndo { .. })));
}

#[test]
fn faults_are_named_in_one_line() {
    let (portrait, _) = sample();
    let refusal = |portrait: &Portrait, part: &str| {
        let (_folder, path, _) = saved(portrait);
        let error = Portrait::load(&path).unwrap_err().to_string();
        assert!(error.contains("somebody.cnerf") && error.contains(part) && !error.contains('\n'), "{error}");
    };
    let tensor = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
    refusal(&Portrait { codes: tensor(&[8, 2, 6]), ..portrait.clone() }, "`codes` has shape [8, 2, 6]");
    refusal(&Portrait { codes: (tensor(&[9, 2, 6]) / 0.0).unwrap(), ..portrait.clone() }, "not finite");
    refusal(&Portrait { codes: tensor(&[9, 2, 5]), ..portrait.clone() }, "`undo.0.codes`");
    refusal(&Portrait { upsampler_code: Some(tensor(&[2, 3])), ..portrait.clone() }, "`upsampler_code`");
    refusal(&Portrait { tint: Some(tensor(&[3, 9])), ..portrait.clone() }, "`tint`");
    refusal(&Portrait { noise: vec![tensor(&[3])], ..portrait.clone() }, "`noise.0`");
    refusal(&Portrait { camera: Camera::at(1e9, 0.0), ..portrait.clone() }, "camera");

    let (_folder, path, _) = saved(&portrait);
    let (mut tensors, metadata) = file::parse_safetensors(&path, &std::fs::read(&path).unwrap()).unwrap();
    tensors.insert("surprise".into(), tensor(&[1]));
    file::write_safetensors(&path, &tensors, &[(HEADER_KEY, metadata[HEADER_KEY].clone())]).unwrap();
    assert!(Portrait::load(&path).unwrap_err().to_string().contains("`surprise`"));
    file::write_safetensors(&path, &tensors, &[]).unwrap();
    assert!(Portrait::load(&path).unwrap_err().to_string().contains("cnerf invert"));
}

#[test]
fn mutated_files_never_panic() {
    let (portrait, _) = sample();
    let (_folder, path, bytes) = saved(&portrait);
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut random = Stream::new(1, &[]);
    let mut accepted = 0;
    for round in 0..2_000 {
        let mut mutated = bytes.clone();
        // Half of the mutations in the header, where the structure is.
        let range = if round % 2 == 0 { header } else { mutated.len() };
        for _ in 0..=random.below(4) {
            let at = random.below(range);
            mutated[at] = match random.below(3) {
                0 => random.bits() as u8,
                1 => mutated[at].wrapping_add(1),
                _ => b"0123456789-.eE\"[]{},:"[random.below(21)],
            };
        }
        if random.chance(0.1) {
            mutated.truncate(random.below(mutated.len()));
        }
        match Portrait::parse(&path, &mutated) {
            Ok(_) => accepted += 1,
            Err(error) => {
                let error = error.to_string();
                assert!(error.contains("somebody.cnerf") && !error.contains('\n'), "{error}");
            }
        }
    }
    assert!(accepted < 2_000, "a reader that accepts everything checks nothing");
}
