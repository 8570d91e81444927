//! The ablation program, with numbers so small that it takes seconds.

use std::process::Command;

#[test]
fn every_variant_trains_and_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    let tiny = "--heads 10 --size 16 --width 4 --style 4 --warmup-steps 3 --field-steps 1 --upsampler-steps 2 \
                --portraits 1 --pictures 8";
    let run = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ablation"));
        command.arg(folder.path()).args(tiny.split_whitespace()).args(more).output().unwrap()
    };
    let output = run(&[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("ablation.json")).unwrap()).unwrap();
    let rows = report["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 19);
    for row in rows {
        assert!(row["failed"].is_null(), "{row}");
        assert!(row["reconstruction_psnr"].as_f64().is_some_and(|psnr| psnr > 0.0), "{row}");
    }
    let weights = |name: &str| {
        rows.iter().find(|row| row["variant"] == name).and_then(|row| row["field_weights"].as_u64()).unwrap()
    };
    assert!(weights("single network") < weights("ours") / 5);
    let table = String::from_utf8(output.stdout).unwrap();
    assert_eq!(table.lines().count(), 21, "{table}");
    assert!(table.lines().all(|line| line.matches('|').count() == 11), "{table}");

    // Models that are there are only measured again.
    let again = run(&["--only", "ours;density"]);
    let table = String::from_utf8(again.stdout).unwrap();
    assert_eq!((table.lines().count(), again.stderr.is_empty()), (4, true), "{table}");
    assert!(!run(&["--only", "theirs"]).status.success());
}
