//! NumPy's `.npy` arrays, read without trusting their header.

use std::path::Path;

use crate::error::{Error, Result};

/// A numeric array in row order.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Array {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f64>,
}

impl Array {
    /// Parses version 1 to 3 of the format: booleans, integers and floats of little-endian order, rows first. The
    /// shape must account for every byte of the file; `name` stands in errors.
    pub(super) fn parse(bytes: &[u8], name: &Path) -> Result<Self> {
        let refuse = |reason: String| Error::malformed(name, reason);
        let not_npy = || refuse("not a whole .npy file; save it again with numpy.save".into());
        let version = match bytes.get(..8) {
            Some([0x93, b'N', b'U', b'M', b'P', b'Y', version @ 1..=3, _]) => *version,
            _ => return Err(not_npy()),
        };
        let length_size = if version == 1 { 2 } else { 4 };
        let mut length = [0u8; 4];
        let start = 8 + length_size;
        length[..length_size].copy_from_slice(bytes.get(8..start).ok_or_else(not_npy)?);
        let end = start.saturating_add(u32::from_le_bytes(length) as usize);
        let (header, data) = (bytes.get(start..end).ok_or_else(not_npy)?, &bytes[end..]);
        let header = std::str::from_utf8(header).map_err(|_| not_npy())?;

        let kind = field(header, "descr").and_then(|value| value.trim_start_matches(['\'', '"']).get(..3));
        let kind = kind.ok_or_else(|| refuse("an array of records; save plain numbers".into()))?;
        if !field(header, "fortran_order").is_some_and(|value| value.starts_with("False")) {
            return Err(refuse("stored columns first; save numpy.ascontiguousarray of it".into()));
        }
        let shape = field(header, "shape").and_then(shape).ok_or_else(not_npy)?;
        let width = match kind {
            "|b1" | "|u1" | "|i1" => 1,
            "<u2" | "<i2" => 2,
            "<u4" | "<i4" | "<f4" => 4,
            "<i8" | "<u8" | "<f8" => 8,
            _ => return Err(refuse(format!("elements of type `{kind}`; save bool, integer or float arrays"))),
        };
        let elements = shape.iter().try_fold(1usize, |product, &size| product.checked_mul(size));
        if elements.and_then(|elements| elements.checked_mul(width)) != Some(data.len()) {
            let found = data.len() / width;
            return Err(refuse(format!(
                "shape {shape:?} does not fit the {found} elements that follow; save it again"
            )));
        }
        let values = data.chunks_exact(width).map(|element| {
            let mut padded = [0u8; 8];
            padded[..width].copy_from_slice(element);
            let unsigned = u64::from_le_bytes(padded);
            let unused = 64 - 8 * width as u32;
            match kind {
                "<f4" => f64::from(f32::from_bits(unsigned as u32)),
                "<f8" => f64::from_bits(unsigned),
                "|i1" | "<i2" | "<i4" | "<i8" => (((unsigned << unused) as i64) >> unused) as f64,
                _ => unsigned as f64,
            }
        });
        Ok(Self { values: values.collect(), shape })
    }
}

/// What follows `'key':` in the header, a Python dictionary.
fn field<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let at = [format!("'{key}'"), format!("\"{key}\"")];
    let (_, rest) = at.iter().find_map(|key| header.split_once(key.as_str()))?;
    Some(rest.trim_start().strip_prefix(':')?.trim_start())
}

/// A tuple of sizes.
fn shape(text: &str) -> Option<Vec<usize>> {
    let (inside, _) = text.strip_prefix('(')?.split_once(')')?;
    inside.split(',').map(str::trim).filter(|size| !size.is_empty()).map(|size| size.parse().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn parse(header: &str, data: &[u8]) -> Result<Array> {
        Array::parse(&file(header, data), Path::new("mask.npy"))
    }

    #[test]
    fn arrays_of_every_type_are_read() {
        let found = parse("{'descr': '|b1', 'fortran_order': False, 'shape': (2, 1), }", &[0, 1]).unwrap();
        assert_eq!((found.shape, found.values), (vec![2, 1], vec![0.0, 1.0]));
        let found = parse("{'descr': '<i8', 'fortran_order': False, 'shape': (1,), }", &(-3i64).to_le_bytes()).unwrap();
        assert_eq!(found.values, [-3.0]);
        let found = parse("{'descr': '<i2', 'fortran_order': False, 'shape': (1,), }", &(-3i16).to_le_bytes()).unwrap();
        assert_eq!(found.values, [-3.0]);
        let found = parse("{'descr': '<u4', 'fortran_order': False, 'shape': (1,)}", &u32::MAX.to_le_bytes()).unwrap();
        assert_eq!(found.values, [4_294_967_295.0]);
        let found = parse("{'descr': '<f4', 'fortran_order': False, 'shape': ()}", &0.5f32.to_le_bytes()).unwrap();
        assert_eq!((found.shape, found.values), (vec![], vec![0.5]));
    }

    #[test]
    fn hostile_headers_are_refused_by_name() {
        let absurd = "{'descr': '|u1', 'fortran_order': False, 'shape': (18446744073709551615, 2), }";
        let huge = "{'descr': '|u1', 'fortran_order': False, 'shape': (9, 4294967295, 4294967295), }";
        let short = "{'descr': '|u1', 'fortran_order': False, 'shape': (9, 4, 4), }";
        let negative = "{'descr': '|u1', 'fortran_order': False, 'shape': (-1, 4), }";
        let objects = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }";
        let records = "{'descr': [('a', '|u1')], 'fortran_order': False, 'shape': (4,), }";
        let columns = "{'descr': '|u1', 'fortran_order': True, 'shape': (2, 2), }";
        for header in [absurd, huge, short, negative, objects, records, columns, "", "{"] {
            let error = parse(header, &[0; 4]).unwrap_err().to_string();
            assert!(error.starts_with("mask.npy: ") && !error.contains('\n'), "{header}: {error}");
        }
        let whole = file(short, &[0; 144]);
        assert!(Array::parse(&whole, Path::new("mask.npy")).is_ok());
        for kept in 0..whole.len() {
            assert!(Array::parse(&whole[..kept], Path::new("mask.npy")).is_err());
        }
    }
}
