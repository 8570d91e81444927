//! `cnerf bench` on settings small enough to wait for: the keys that others read, files, exit codes. Speeds are not judged.

use cnerf_tests::{Folder, MODEL, number};
use serde_json::Value;

/// The report as printed, which must be the one in the file.
fn bench(folder: &Folder, line: &str, out: &str) -> Value {
    let printed = folder.json(&format!("bench {line} --out {out}"));
    let written: Value = serde_json::from_slice(&folder.read(&format!("{out}/report.json"))).unwrap();
    assert_eq!(printed, written);
    printed
}

fn assert_chart(folder: &Folder, name: &str) {
    let svg = String::from_utf8(folder.read(name)).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("threads") && !svg.contains("NaN"), "{name}");
}

fn assert_positive(value: &Value, keys: &[&str]) {
    for key in keys {
        assert!(number(value, key) > 0.0, "{key} in {value}");
    }
}

#[test]
fn stability_lists_cases_and_none_fails() {
    let folder = Folder::new("stability");
    let report = bench(&folder, "stability --only aggregation", "out");
    let cases = report["cases"].as_array().unwrap();
    assert!(cases.len() >= 5 && report["failed"] == 0, "{report}");
    for case in cases {
        assert!(case["name"].as_str().unwrap().starts_with("aggregation"));
        assert_eq!(case["finite"], true, "{case}");
        assert!(number(case, "max_rel_error_vs_f64") < 1e-3, "{case}");
    }
    assert_chart(&folder, "out/stability.svg");
    let again = folder.run("bench stability --only aggregation --out out");
    assert!(again.code == 2 && again.stderr.contains("--overwrite"), "{again:?}");
    let none = folder.run("bench stability --only flying --out none");
    assert!(none.code == 2 && !folder.path("none").exists(), "{none:?}");
}

#[test]
fn convolutions_are_compared_to_candle() {
    let folder = Folder::new("conv");
    let rows = bench(&folder, "conv --config small --repeats 1 --paths portable", "out");
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), 6);
    for row in rows {
        assert!(row["shape"].is_string() && row["pass"].is_string());
        assert_positive(row, &["gflops", "plain_gflops", "peak_gflops"]);
    }
    assert_chart(&folder, "out/conv.svg");
    let unknown = folder.run("bench conv --paths fpga --out other");
    assert!(unknown.code == 2 && unknown.stderr.contains("fpga"), "{unknown:?}");
}

#[test]
fn training_steps_have_speed_memory_and_exact_gradients() {
    let folder = Folder::new("train");
    let report = bench(&folder, "train --config tiny --repeats 1 --batch 1 --steps pivot,training", "out");
    assert_positive(&report, &["plain_seconds_per_image", "fused_seconds_per_image"]);
    assert!(number(&report, "gradient_rel_error") < 1e-4);
    if cfg!(target_os = "linux") {
        assert!(number(&report, "peak_rss_bytes") > 1e6);
    }
    assert_eq!(report["steps"].as_array().map(Vec::len), Some(2));
    assert_chart(&folder, "out/train_seconds.svg");
}

#[test]
fn frames_are_compared_exact_budgeted_and_converged() {
    let folder = Folder::with_model("render");
    let tiny = format!("--model {MODEL} --resolution 12 --samples 8 --repeats 1");
    let report = bench(&folder, &format!("render {tiny} --budgets 0.01"), "out");
    let keys = ["points_per_s", "gflops", "peak_gflops", "plain_seconds", "exact_seconds"];
    assert_positive(&report, &keys);
    let budgeted = &report["budgeted"][0];
    assert_eq!(number(budgeted, "budget"), 0.01);
    assert!(number(budgeted, "max_error") <= number(budgeted, "bound") && number(budgeted, "bound") <= 0.01);
    assert_positive(budgeted, &["seconds", "regions_evaluated", "samples_evaluated"]);
    assert!(number(budgeted, "mean_error") <= number(budgeted, "max_error"));
    let sums = report["discretisation"].as_array().unwrap();
    assert!(sums.iter().all(|sum| number(sum, "samples") >= 1.0 && number(sum, "seconds") > 0.0));
    assert!(number(&sums[sums.len() - 2], "psnr") > number(&sums[0], "psnr"), "more samples come closer");
    for chart in ["paths", "budgets", "discretisation", "roofline"] {
        assert_chart(&folder, &format!("out/{chart}.svg"));
    }
}

#[test]
fn sequences_and_edits_stay_within_their_budgets() {
    let folder = Folder::with_model("plans");
    let tiny = format!("--model {MODEL} --resolution 12 --samples 8");
    let report = bench(&folder, &format!("sequence {tiny} --frames 3 --budget 0.01"), "sequence");
    assert_eq!(report["frames"], 3);
    assert_positive(&report, &["exact_seconds_per_frame", "shared_seconds_per_frame"]);
    assert!(number(&report, "max_error") <= 0.01);
    assert_chart(&folder, "sequence/sequence.svg");
    let report = bench(&folder, &format!("edit {tiny} --region mouth --repeats 1"), "edit");
    assert_positive(&report, &["full_seconds", "incremental_seconds"]);
    assert!(number(&report, "max_error") <= 0.002);
    assert_chart(&folder, "edit/edit.svg");
}
