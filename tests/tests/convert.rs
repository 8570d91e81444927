//! The authors' checkpoints become models that the other commands take.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

use cnerf_tests::{Folder, has_content, number};

/// Where the authors' checkpoint `name` is, if this machine has it.
fn checkpoint(name: &str) -> Option<PathBuf> {
    let folder = env::var_os("CNERF_REFERENCE")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/reference"), PathBuf::from);
    let path = folder.join(name);
    if !path.exists() {
        println!("skipped: {} is not on this machine", path.display());
        return None;
    }
    Some(path)
}

/// Converts a checkpoint, checks what `convert` and `info` say of it, and generates a portrait of `size` with it.
fn converts(name: &str, stage: &str, size: u32) {
    let Some(path) = checkpoint(&format!("{name}.pt")) else { return };
    let folder = Folder::new(name);
    fs::copy(path, folder.path("authors.pt")).unwrap();
    let converted = folder.json("convert authors.pt --out model.safetensors");
    assert_eq!(converted["stage"], stage);
    let info = folder.json("info model.safetensors");
    assert_eq!(info["kind"], "model");
    assert_eq!(info["hash"], converted["hash"]);
    assert_eq!(info["parameters"], converted["parameters"]);
    assert_eq!(number(&info, "output_resolution"), f64::from(size));
    assert_eq!(info["config"]["upsampler"].is_object(), stage == "full");
    let raw = folder.json("convert authors.pt --raw --out raw.safetensors");
    assert!(raw["hash"] != converted["hash"], "the weights and their moving average are two things");
    fs::create_dir(folder.path("random")).unwrap();
    folder.run("generate --model model.safetensors --seeds 0 --out random").done();
    let picture = folder.picture("random/seed0000.png");
    assert_eq!(picture.dimensions(), (size, size));
    assert!(has_content(&picture), "a flat picture");
}

#[test]
fn the_authors_first_stage_checkpoint_becomes_a_model() {
    converts("tiny_s0_vol_renderer", "field", 64);
}

#[test]
fn the_authors_full_checkpoint_becomes_a_model() {
    converts("tiny_s0_full_pipeline", "full", 64);
}
