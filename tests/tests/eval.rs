//! `cnerf eval` as a user calls it, on the shared tiny model.

use std::path::PathBuf;

use cnerf_tests::{DATA, Folder, MODEL, number};
use serde_json::Value;

/// LPIPS weights of the reference data, if they are here.
fn lpips() -> Option<PathBuf> {
    let reference = std::env::var_os("CNERF_REFERENCE")
        .map_or_else(|| concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/reference").into(), PathBuf::from);
    let path = reference.join("../weights/lpips_alexnet.safetensors");
    if path.is_file() {
        return Some(path);
    }
    println!("skipped: no {}", path.display());
    None
}

fn is_chart(folder: &Folder, name: &str) -> bool {
    let text = String::from_utf8(folder.read(name)).unwrap();
    text.starts_with("<svg") && text.trim_end().ends_with("</svg>")
}

#[test]
fn quality_without_features_compares_sharpness_and_regions() {
    let folder = Folder::with_model("quality");
    let line = format!("eval quality --model {MODEL} --data {DATA} --count 8 --reconstructions 4");
    let report = folder.json(&format!("{line} --threads 1 --plots charts"));
    assert_eq!((&report["fid"], &report["kid"], &report["features"]), (&Value::Null, &Value::Null, &Value::Null));
    assert_eq!((number(&report, "count"), number(&report, "resolution")), (8.0, 32.0));
    assert!(number(&report["sharpness"], "share") > 0.0 && number(&report["nyquist"], "share") > 0.0);
    assert!((0.0..=1.0).contains(&number(&report, "region_map_overlap")), "{report}");
    // The shared model was trained on this data and its codes lie beside it.
    assert!((0.0..=1.0).contains(&number(&report, "mask_miou")), "{report}");
    assert_eq!(number(&report["reconstruction"], "count"), 4.0);
    assert!(number(&report["reconstruction"], "render_psnr") > 8.0, "{report}");
    assert!(number(&report["reconstruction"]["sharpness"], "real") > 0.0, "{report}");
    for chart in ["sharpness", "nyquist", "regions"] {
        assert!(is_chart(&folder, &format!("charts/{chart}.svg")), "{chart}");
    }
    let refused = folder.run(&format!("{line} --plots charts"));
    assert!(refused.code == 2 && refused.stderr.contains("--overwrite"), "{}", refused.stderr);
    // The same at any thread count, but for the time it took.
    let mut again = folder.json(&format!("{line} --threads 2"));
    again["seconds"] = report["seconds"].clone();
    assert_eq!(again, report);
}

#[test]
fn quality_with_features_has_a_floor_and_a_blur_reference() {
    let Some(weights) = lpips() else { return };
    let folder = Folder::with_model("features");
    let line = format!("eval quality --model {MODEL} --data {DATA} --count 12 --reconstructions 0");
    let report = folder.json(&format!("{line} --features {} --plots charts", weights.display()));
    assert_eq!(report["features"], "lpips-alexnet-relu5");
    let [fid, floor, blur] = ["fid", "floor_fid", "blur_fid"].map(|key| number(&report, key));
    // 72 optimiser steps make no portraits: farther from the photos than the photos are from each other.
    assert!(fid > floor && floor > 0.0 && blur > 0.0, "{report}");
    assert!(number(&report, "kid") > number(&report, "floor_kid"), "{report}");
    assert_eq!((&report["fid_infinity"], &report["mask_miou"]), (&Value::Null, &Value::Null));
    for key in ["precision", "recall"] {
        assert!((0.0..=1.0).contains(&number(&report, key)), "{report}");
    }
    assert!(is_chart(&folder, "charts/distances.svg"));
    folder.write("other.safetensors", b"not weights");
    let refused = folder.run(&format!("{line} --features other.safetensors"));
    assert!(refused.code == 2 && refused.stderr.contains("other.safetensors"), "{}", refused.stderr);
    assert_eq!(refused.stderr.lines().filter(|line| line.starts_with("error")).count(), 1);
    let refused = folder.run(&format!("{line} --features {} --features-input unit", weights.display()));
    assert!(refused.code == 2 && refused.stderr.contains("--features-input"), "{}", refused.stderr);
}

#[test]
fn consistency_measures_random_portraits_and_portrait_files() {
    let folder = Folder::with_model("consistency");
    let report = folder.json(&format!("eval consistency --model {MODEL} --data {DATA} --count 2 --plots charts"));
    assert_eq!(report["portraits"].as_array().map(Vec::len), Some(2));
    assert_eq!(report["portraits"][1]["portrait"], "seed 1");
    assert!(number(&report, "reprojection_psnr") > 5.0, "{report}");
    assert!((0.0..=1.0).contains(&number(&report, "mask_consistency")), "{report}");
    assert!((0.0..=1.0).contains(&number(&report, "visible_share")), "{report}");
    let [near, far] = [0, 1].map(|index| number(&report["detail"][index], "correlation"));
    assert!(near > far, "detail agrees better at 0.05 rad than at 0.4: {report}");
    assert!(is_chart(&folder, "charts/reprojection.svg") && is_chart(&folder, "charts/detail.svg"));

    folder.photo("photo.png");
    let few = "--effort fast --pivot-steps 4 --tune-steps 1 --out .";
    folder.run(&format!("invert photo.png --model {MODEL} {few}")).done();
    let report = folder.json(&format!("eval consistency photo.cnerf --model {MODEL}"));
    assert_eq!(report["portraits"][0]["portrait"], "photo.cnerf");
    let both = folder.run(&format!("eval consistency photo.cnerf --data {DATA}"));
    assert_eq!(both.code, 2, "{}", both.stderr);
}

#[test]
fn consistency_of_drawn_heads_stands_beside_the_models() {
    let folder = Folder::with_model("reference");
    folder.run("synth --count 2 --size 64 --with depth --turns=-0.3,0.3,-0.05,0.05 --out views").done();
    let report = folder.json(&format!("eval consistency --model {MODEL} --count 1 --reference views"));
    let reference = &report["reference"];
    assert_eq!(number(reference, "count"), 2.0);
    // Drawings seen from other sides by their exact depth: edges thinner than pixels differ, nothing else does.
    assert!((18.0..40.0).contains(&number(reference, "reprojection_psnr")), "{reference}");
    assert!(number(&reference["detail"][0], "correlation") > 0.8, "{reference}");
    assert_eq!(reference["detail"][1]["correlation"], Value::Null, "no view is turned by 0.4 rad");
    let shown = folder.run(&format!("eval consistency --model {MODEL} --count 1 --reference views")).done();
    assert!(shown.stdout.contains("heads of the reference"), "{}", shown.stdout);

    folder.run("synth --count 1 --size 32 --out flat").done();
    let refused = folder.run(&format!("eval consistency --model {MODEL} --count 1 --reference flat"));
    assert!(refused.code == 2 && refused.stderr.contains("flat: no head with depth"), "{}", refused.stderr);
}

#[test]
fn locality_measures_every_region_and_texture_moves_nothing() {
    let folder = Folder::with_model("locality");
    let report = folder.json(&format!("eval locality --model {MODEL} --count 2 --plots charts"));
    let rows = report["regions"].as_array().unwrap();
    assert_eq!(rows.len(), 18);
    assert_eq!(number(&report, "texture_depth_change"), 0.0);
    for row in rows {
        // The background lies on the far plane: it has no shape to move.
        let moves = row["aspect"] == "shape" && row["region"] != "background";
        assert_eq!(moves, number(row, "depth_change") > 0.0, "{row}");
        assert!(number(row, "outside_change") >= 0.0, "{row}");
    }
    let separation = &report["separation"];
    assert_eq!((number(&separation["texture"], "masks"), number(&separation["texture"], "depth")), (0.0, 0.0));
    for key in ["masks", "depth", "colour", "region_colour", "features"] {
        assert!(number(&separation["shape"], key) > 0.0, "{key}: {separation}");
    }
    assert!(number(&separation["texture"], "region_colour") > 0.0, "{separation}");
    let row = |region: &str, aspect: &str| rows.iter().find(|row| row["region"] == region && row["aspect"] == aspect);
    let hair = row("hair", "texture").unwrap();
    assert!(number(hair, "inside_change") > number(hair, "outside_change"), "{hair}");
    for chart in ["shape", "texture", "depth"] {
        assert!(is_chart(&folder, &format!("charts/{chart}.svg")), "{chart}");
    }
}

#[test]
fn inversion_measures_views_it_was_not_shown() {
    let folder = Folder::with_model("inversion");
    folder.run("synth --count 2 --views 2 --size 64 --seed 5 --with depth --out views").done();
    let line = format!("eval inversion --model {MODEL} --data views --count 2 --pivot-steps 12 --tune-steps 3");
    let report = folder.json(&format!("{line} --variant ours,pivot --known-masks --plots charts"));
    assert_eq!((number(&report, "count"), number(&report, "failed")), (2.0, 0.0));
    for key in ["seconds", "psnr", "ms_ssim", "novel_view_psnr", "pose_error_rad", "mask_miou"] {
        assert!(number(&report, key) >= 0.0, "{key}");
    }
    assert!((-1.0..=1.0).contains(&number(&report, "depth_correlation")), "{report}");
    assert_eq!(report["lpips"], Value::Null);
    let [ours, pivot] = [0, 1].map(|index| report["variants"][index].clone());
    assert_eq!((&ours["variant"], &pivot["variant"]), (&"ours".into(), &"pivot".into()));
    // Tuning never shows the photo worse than the pivot it began with.
    assert!(number(&ours, "psnr") > number(&pivot, "psnr") - 0.1, "{report}");
    assert_eq!(number(&pivot, "depth_drift"), 0.0);
    for chart in ["psnr_over_time", "psnr", "novel_views"] {
        assert!(is_chart(&folder, &format!("charts/{chart}.svg")), "{chart}");
    }
}

#[test]
fn efforts_are_compared_and_their_portraits_kept() {
    let folder = Folder::with_model("efforts");
    folder.run("synth --count 2 --size 64 --seed 5 --with depth --turns -0.4,-0.2,0.2,0.4 --out views").done();
    let few = "--pivot-steps 8 --tune-steps 1 --efforts fast,balanced --variant ours,pivot";
    let line = format!("eval inversion --model {MODEL} --data views {few} --plots charts --portraits made");
    let report = folder.json(&line);
    let rows = report["variants"].as_array().unwrap();
    let named = |row: &Value| format!("{} {}", row["effort"], row["variant"]).replace('"', "");
    assert_eq!(
        rows.iter().map(named).collect::<Vec<_>>(),
        ["fast ours", "fast pivot", "balanced ours", "balanced pivot"]
    );
    for row in rows {
        let turns = row["novel_views_by_turn"].as_array().unwrap();
        let told: Vec<_> = turns.iter().map(|turn| (number(turn, "turn_rad"), number(turn, "count"))).collect();
        assert_eq!(told, [(0.2, 4.0), (0.4, 4.0)], "{row}");
        assert!(turns.iter().all(|turn| number(turn, "psnr") > 0.0 && number(turn, "foreground_psnr") > 0.0));
    }
    let chart = String::from_utf8(folder.read("charts/psnr_over_effort.svg")).unwrap();
    assert!(is_chart(&folder, "charts/psnr_over_effort.svg") && chart.contains("ours, views not shown"));
    assert!(!folder.path("charts/lpips_over_effort.svg").exists(), "there are no weights to measure it by");
    assert_eq!(folder.list("made"), ["00000.cnerf", "00005.cnerf"]);
    let kept = folder.json("info made/00000.cnerf");
    let first = report["variants"][0]["portraits"].as_array().unwrap();
    let first = first.iter().find(|score| score["input"] == "images/00000.png").unwrap();
    assert_eq!(number(&kept["metrics"], "psnr"), number(first, "psnr"));

    let refused = folder.run(&line.replace("--plots charts ", ""));
    assert!(refused.code == 2 && refused.stderr.contains("--overwrite"), "{}", refused.stderr);
    let both = folder.run(&format!("{line} --effort fast --overwrite"));
    assert_eq!(both.code, 2, "{}", both.stderr);
    let locality = folder.json(&format!("eval locality made/00000.cnerf made/00005.cnerf --model {MODEL}"));
    assert_eq!(number(&locality, "texture_depth_change"), 0.0);
}

#[test]
fn photos_that_cannot_be_inverted_are_counted() {
    let folder = Folder::with_model("failures");
    folder.photo("photos_astronaut.png");
    std::fs::create_dir(folder.path("photos")).unwrap();
    std::fs::rename(folder.path("photos_astronaut.png"), folder.path("photos/astronaut.png")).unwrap();
    folder.write("photos/broken.png", b"no picture");
    let few = "--pivot-steps 4 --tune-steps 1 --quiet --json";
    let run = folder.run(&format!("eval inversion --model {MODEL} --data photos {few}"));
    assert_eq!(run.code, 1, "{}", run.stderr);
    let report = run.json();
    assert_eq!((number(&report, "count"), number(&report, "failed")), (1.0, 1.0));
    assert_eq!((&report["novel_view_psnr"], &report["depth_correlation"]), (&Value::Null, &Value::Null));
    let failure = &report["variants"][0]["failures"][0];
    assert!(failure["input"].as_str().is_some_and(|input| input.ends_with("broken.png")), "{failure}");
    std::fs::remove_file(folder.path("photos/astronaut.png")).unwrap();
    let none = folder.run(&format!("eval inversion --model {MODEL} --data photos {few}"));
    assert!(none.code == 2 && none.stderr.contains("broken.png"), "{}", none.stderr);
}
