use std::io::{Cursor, Write as _};

use candle_core::DType;
use zip::{ZipWriter, write::SimpleFileOptions};

use super::*;
use crate::rng::Stream;

/// Assembles the pickles that `torch.save` writes.
#[derive(Clone, Default)]
struct Program(Vec<u8>);

impl Program {
    fn new() -> Self {
        Self(vec![0x80, 2])
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn text(self, text: &str) -> Self {
        self.raw(b"X").raw(&(text.len() as u32).to_le_bytes()).raw(text.as_bytes())
    }

    fn integer(self, value: usize) -> Self {
        self.raw(b"J").raw(&(value as u32).to_le_bytes())
    }

    fn tuple(self, values: &[usize]) -> Self {
        values.iter().fold(self.raw(b"("), |program, &value| program.integer(value)).raw(b"t")
    }

    fn tensor(
        self,
        class: &str,
        key: &str,
        elements: usize,
        offset: usize,
        shape: &[usize],
        strides: &[usize],
    ) -> Self {
        self.raw(b"ctorch._utils\n_rebuild_tensor_v2\n((")
            .text("storage")
            .raw(format!("ctorch\n{class}\n").as_bytes())
            .text(key)
            .text("cpu")
            .integer(elements)
            .raw(b"tQ")
            .integer(offset)
            .tuple(shape)
            .tuple(strides)
            .raw(b"\x89ccollections\nOrderedDict\n)RtR")
    }

    fn archive(self, storages: &[(&str, &[u8])]) -> Vec<u8> {
        self.archive_with(storages, CompressionMethod::Stored)
    }

    fn archive_with(self, storages: &[(&str, &[u8])], compression: CompressionMethod) -> Vec<u8> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default().compression_method(compression);
        let mut add = |name: &str, bytes: &[u8]| {
            zip.start_file(format!("tiny/{name}"), options).unwrap();
            zip.write_all(bytes).unwrap();
        };
        add("data.pkl", &self.raw(b".").0);
        add("byteorder", b"little");
        storages.iter().for_each(|(key, bytes)| add(&format!("data/{key}"), bytes));
        zip.finish().unwrap().into_inner()
    }
}

fn load(bytes: &[u8]) -> pickle::Result<Checkpoint> {
    read(Cursor::new(bytes), bytes.len() as u64)
}

fn refusal(bytes: &[u8]) -> String {
    let reason = load(bytes).expect_err("must be refused");
    assert!(!reason.contains('\n'), "one line: {reason}");
    reason
}

fn floats(values: std::ops::Range<usize>) -> Vec<u8> {
    values.flat_map(|value| (value as f32).to_le_bytes()).collect()
}

/// {"g": OrderedDict{"a": [2, 3], "a_t": transposed view, "tail": view at an offset, "flags": bool}, "step": 7, 1: [None, 0.5]}
fn tiny() -> Vec<u8> {
    Program::new()
        .raw(b"}(")
        .text("g")
        .raw(b"ccollections\nOrderedDict\n)Rq\x05(")
        .text("a")
        .tensor("FloatStorage", "0", 6, 0, &[2, 3], &[3, 1])
        .raw(b"q\x06")
        .text("a_t")
        .tensor("FloatStorage", "0", 6, 0, &[3, 2], &[1, 3])
        .text("tail")
        .raw(b"ctorch._utils\n_rebuild_parameter\n")
        .tensor("FloatStorage", "0", 6, 4, &[2], &[1])
        .raw(b"\x88ccollections\nOrderedDict\n)R\x87R")
        .text("flags")
        .tensor("BoolStorage", "1", 3, 0, &[3], &[1])
        .text("again")
        .raw(b"h\x06u}")
        .text("_metadata")
        .raw(b"}sb")
        .text("step")
        .raw(b"K\x07K\x01](NG\x3f\xe0\0\0\0\0\0\0eu")
        .archive(&[("0", &floats(0..6)), ("1", &[1, 0, 1])])
}

#[test]
fn nested_dicts_views_and_plain_values_are_read() {
    let checkpoint = load(&tiny()).unwrap();
    let flat = checkpoint.flatten();
    let names: Vec<_> = flat.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["g.a", "g.a_t", "g.tail", "g.flags", "g.again"]);
    let tensor = |name: &str| checkpoint.get("g").and_then(|g| g.get(name)).and_then(Value::tensor).unwrap();
    assert_eq!(tensor("a").to_vec2::<f32>().unwrap(), [[0., 1., 2.], [3., 4., 5.]]);
    assert_eq!(tensor("a_t").to_vec2::<f32>().unwrap(), [[0., 3.], [1., 4.], [2., 5.]]);
    assert_eq!(tensor("tail").to_vec1::<f32>().unwrap(), [4., 5.]);
    assert_eq!(tensor("flags").to_vec1::<u8>().unwrap(), [1, 0, 1]);
    assert_eq!(tensor("again").id(), tensor("a").id(), "an object met twice is one tensor");
    assert!(matches!(checkpoint.get("step"), Some(Value::Integer(7))));
    let Value::Dict(entries) = &checkpoint.root else { panic!() };
    assert_eq!(entries[2].0, Key::Integer(1));
    assert!(matches!(&entries[2].1, Value::List(items) if matches!(items[..], [Value::None, Value::Float(0.5)])));
}

#[test]
fn every_element_type_keeps_its_values_whole_and_strided() {
    for (class, dtype, bytes) in [
        ("DoubleStorage", DType::F64, [1f64, 2.0, 3.0, 4.0].map(f64::to_le_bytes).concat()),
        ("FloatStorage", DType::F32, [1f32, 2.0, 3.0, 4.0].map(f32::to_le_bytes).concat()),
        ("HalfStorage", DType::F16, [1f32, 2.0, 3.0, 4.0].map(|x| half::f16::from_f32(x).to_le_bytes()).concat()),
        ("BFloat16Storage", DType::BF16, [1f32, 2.0, 3.0, 4.0].map(|x| half::bf16::from_f32(x).to_le_bytes()).concat()),
        ("LongStorage", DType::I64, [1i64, 2, 3, 4].map(i64::to_le_bytes).concat()),
        ("IntStorage", DType::I32, [1i32, 2, 3, 4].map(i32::to_le_bytes).concat()),
        ("ShortStorage", DType::I16, [1i16, 2, 3, 4].map(i16::to_le_bytes).concat()),
        ("ByteStorage", DType::U8, vec![1, 2, 3, 4]),
    ] {
        for (strides, expected) in [([2, 1], [[1., 2.], [3., 4.]]), ([1, 2], [[1., 3.], [2., 4.]])] {
            let file = Program::new().tensor(class, "0", 4, 0, &[2, 2], &strides).archive(&[("0", &bytes)]);
            let flat = load(&file).unwrap().flatten();
            assert_eq!(flat[0].1.dtype(), dtype);
            let values = flat[0].1.to_dtype(DType::F64).unwrap().to_vec2::<f64>().unwrap();
            assert_eq!(values, expected, "{class}");
        }
        let empty = Program::new().tensor(class, "0", 0, 0, &[0, 5], &[5, 1]).archive(&[("0", &[])]);
        assert_eq!(load(&empty).unwrap().flatten()[0].1.dims(), [0, 5]);
    }
}

#[test]
fn anything_that_could_execute_is_refused_by_name() {
    let attack = Program::new().raw(b"cos\nsystem\n(").text("touch /tmp/owned").raw(b"tR").archive(&[]);
    assert!(refusal(&attack).contains("`os.system`"), "{}", refusal(&attack));
    let by_stack = Program::new().text("builtins").text("eval").raw(b"\x93").archive(&[]);
    assert!(refusal(&by_stack).contains("`builtins.eval`"));
    let control = Program::new().raw(b"cos\x1b[2J\nsystem\n").archive(&[]);
    assert!(refusal(&control).contains("`os?[2J.system`"));
    // OBJ, INST, NEWOBJ, EXT1: other ways to call.
    for opcode in [b'o', b'i', 0x81, 0x82] {
        assert!(refusal(&Program::new().raw(&[b'(', opcode]).archive(&[])).contains("instruction"));
    }
}

#[test]
fn sizes_that_the_archive_does_not_hold_are_refused() {
    let tensor = |elements, offset, shape: &[usize], strides: &[usize]| {
        Program::new().tensor("FloatStorage", "0", elements, offset, shape, strides).archive(&[("0", &floats(0..6))])
    };
    assert!(refusal(&tensor(1 << 30, 0, &[1 << 30], &[1])).contains("storage 0 has 24 bytes"));
    assert!(refusal(&tensor(6, 1, &[6], &[1])).contains("leaves its storage"));
    assert!(refusal(&tensor(6, 0, &[2, 3], &[4, 1])).contains("leaves its storage"));
    assert!(refusal(&tensor(6, 0, &[1 << 30, 1 << 30, 1 << 30], &[0, 0, 0])).contains("leaves its storage"));
    assert!(refusal(&tensor(6, 0, &[1 << 30], &[0])).contains("unfold"));
    let text = Program::new().raw(b"X\xff\xff\xff\xff").archive(&[]);
    assert!(refusal(&text).contains("text"));
    let missing = Program::new().tensor("FloatStorage", "7", 6, 0, &[6], &[1]).archive(&[]);
    assert!(refusal(&missing).contains("data/7"));
    let path = Program::new().tensor("FloatStorage", "../x", 6, 0, &[6], &[1]).archive(&[]);
    assert!(refusal(&path).contains("names a storage"));
    let zeros = vec![0u8; 1 << 16];
    let bomb = Program::new()
        .tensor("ByteStorage", "0", 1 << 16, 0, &[1 << 16], &[1])
        .archive_with(&[("0", &zeros)], CompressionMethod::Deflated);
    assert!(refusal(&bomb).contains("compressed"));
}

#[test]
fn endless_and_exploding_structures_are_refused() {
    let endless = Program::new().raw(b"]q\x00h\x00a").archive(&[]);
    assert!(refusal(&endless).contains("nested too deeply"));
    // Each list holds the one before it twice: 2^60 values if it were written out.
    let exploding = (0..60u8).fold(Program::new().raw(b"]q\x00"), |program, level| {
        program.raw(&[b']', b'q', level + 1, b'(', b'h', level, b'h', level, b'e'])
    });
    assert!(refusal(&exploding.archive(&[])).contains("values"));
    let marks = Program::new().raw(&vec![b'('; (1 << 20) + 1]).archive(&[]);
    assert!(refusal(&marks).contains("marks"));
}

#[test]
fn other_files_say_what_to_do() {
    assert!(refusal(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.").contains("torch.save"));
    assert!(refusal(b"").contains("not a PyTorch"));
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("a.txt", SimpleFileOptions::default()).unwrap();
    assert!(refusal(&zip.finish().unwrap().into_inner()).contains("data.pkl"));
    let missing = read_checkpoint("/nowhere/x.pt").unwrap_err();
    assert!(missing.to_string().starts_with("/nowhere/x.pt: "));
}

#[test]
fn mutated_files_never_panic() {
    let valid = tiny();
    let directory = valid.windows(4).position(|window| window == b"PK\x01\x02").unwrap();
    let mut refused = 0;
    for seed in 0..2_000 {
        let mut random = Stream::new(seed, &[]);
        let mut bytes = valid.clone();
        for _ in 0..1 + random.below(8) {
            let place = random.below(bytes.len());
            match random.below(4) {
                0 => bytes[place] = random.bits() as u8,
                1 => bytes[place] ^= 1 << random.below(8),
                2 => drop(bytes.drain(place..(place + random.below(8)).min(bytes.len()))),
                _ => bytes.insert(place, random.bits() as u8),
            }
        }
        refused += usize::from(load(&bytes).is_err());
    }
    // Checksums refuse most of those; so the pickle is also mutated inside a zip that is right again.
    let pickle_start = valid.windows(2).position(|window| window == [0x80, 2]).unwrap();
    let program = &valid[pickle_start..directory.min(pickle_start + 1000)];
    let program = &program[..program.windows(2).position(|window| window == b"u.").unwrap() + 1];
    for seed in 0..2_000 {
        let mut random = Stream::new(seed, &[1]);
        let mut bytes = program.to_vec();
        for _ in 0..1 + random.below(6) {
            let place = random.below(bytes.len());
            bytes[place] = *random.pick(b"c(NKMJGXqrhj)tR]ae}suQb.\x85\x86\x87\x88\x89\x8a\x00\x01\xff").unwrap();
        }
        refused += usize::from(load(&Program(bytes).archive(&[("0", &floats(0..6)), ("1", &[1, 0, 1])])).is_err());
    }
    assert!((1_000..4_000).contains(&refused), "{refused} of 4000 mutations refused");
}

/// The authors' layout, with a parameter's bytes compared through an independent path: the zip entry itself.
#[test]
fn the_authors_checkpoints_are_read() {
    let folder = std::env::var_os("CNERF_REFERENCE").map_or_else(
        || Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/reference")).to_owned(),
        Into::into,
    );
    for (name, parts) in [
        ("tiny_s0_vol_renderer.pt", &["g", "gd", "sd", "g_ema"][..]),
        ("tiny_s0_full_pipeline.pt", &["g", "d", "g_ema"][..]),
    ] {
        let path = folder.join(name);
        if !path.exists() {
            println!("skipped: {} is not there", path.display());
            return;
        }
        let checkpoint = read_checkpoint(&path).unwrap();
        let Value::Dict(entries) = &checkpoint.root else { panic!() };
        assert_eq!(entries.iter().map(|(key, _)| key.to_string()).collect::<Vec<_>>(), parts);
        let flat = checkpoint.flatten();
        println!("{name}: {} tensors", flat.len());
        // The first storage is stored at a place the zip's first local headers tell; look its values up in the raw file.
        let file = std::fs::read(&path).unwrap();
        let entry = format!("{}/data/0", name.trim_end_matches(".pt"));
        let header = file.windows(entry.len()).position(|window| window == entry.as_bytes()).unwrap() - 30;
        let length = |place: usize| usize::from(u16::from_le_bytes([file[header + place], file[header + place + 1]]));
        let start = header + 30 + length(26) + length(28);
        let bytes = &file[start..start + flat[0].1.elem_count() * 4];
        let expected: Vec<f32> = bytes.as_chunks().0.iter().copied().map(f32::from_le_bytes).collect();
        assert_eq!(flat[0].1.flatten_all().unwrap().to_vec1::<f32>().unwrap(), expected);
        for (name, tensor) in &flat {
            let sum =
                tensor.to_dtype(DType::F64).unwrap().abs().unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap();
            assert!(sum.is_finite(), "{name}");
        }
    }
}
