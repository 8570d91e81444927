//! Finds and aligns the largest face of every photo: `cargo run --release -p cnerf-invert --example align_photos --
//! OUT PHOTO…` writes `OUT/NAME.png` and prints where each face was and which way it looks.

use std::path::{Path, PathBuf};

use cnerf_invert::{align, detect, photo};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let output = arguments.next().ok_or("usage: align_photos OUT PHOTO…")?;
    std::fs::create_dir_all(&output)?;
    for path in arguments {
        match one(&path) {
            Ok(aligned) => {
                let name = path.file_stem().unwrap_or_default();
                aligned.picture.save(output.join(name).with_extension("png"))?;
                println!(
                    "{}: azimuth {:.3}, elevation {:.3} rad, {:.0} % mirrored, {:?}",
                    path.display(),
                    aligned.camera.azimuth_rad,
                    aligned.camera.elevation_rad,
                    100.0 * aligned.padded,
                    aligned.transform
                );
            }
            Err(error) => eprintln!("{error}"),
        }
    }
    Ok(())
}

fn one(path: &Path) -> cnerf_invert::Result<align::Aligned> {
    let photo = photo::read(path)?;
    let (face, _) = detect::choose(path, &photo, 0)?;
    align::align(&photo, &face, 256)
}
