//! Shared helpers of the end-to-end tests: finds the compiled `cnerf`, runs it in folders of its own, and trains one
//! tiny model that all tests of a test binary share.
//!
//! Every test works in a folder `target/PROFILE/e2e/TEST_BINARY/NAME`, which stays there to look into when it fails and
//! is emptied by the next run. Commands are written as a user types them, with paths relative to that folder.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::Command,
    sync::OnceLock,
    time::Duration,
};

use image::RgbImage;
use serde_json::Value;

/// The shared dataset of 24 cartoon portraits of 64×64, seen from a test's folder.
pub const DATA: &str = "../shared/data";
/// The shared tiny model, seen from a test's folder.
pub const MODEL: &str = "../shared/model/model.safetensors";
/// Width and height of the shared model's pictures, pixels.
pub const MODEL_SIZE: u32 = 32;
/// Far beyond what any command here needs on a busy machine: a hang is reported, not waited for.
const PATIENCE: Duration = Duration::from_secs(300);

/// How a command ended and what it said.
#[derive(Debug)]
pub struct Run {
    /// The command, as typed.
    pub command: String,
    /// Exit code; -1 if a signal ended it.
    pub code: i32,
    /// Results.
    pub stdout: String,
    /// Progress, warnings and errors.
    pub stderr: String,
}

impl Run {
    /// Itself, if the command did all it was asked.
    pub fn done(self) -> Self {
        assert_eq!(self.code, 0, "`cnerf {}` failed: {}", self.command, self.stderr);
        self
    }

    /// stdout as the one JSON value it must be with `--json`.
    pub fn json(&self) -> Value {
        let parsed = serde_json::from_str(&self.stdout);
        parsed.unwrap_or_else(|error| panic!("`cnerf {}` printed no JSON ({error}): {}", self.command, self.stdout))
    }
}

/// A folder that commands run in.
pub struct Folder(PathBuf);

impl Folder {
    /// An empty folder for the test `name`.
    pub fn new(name: &str) -> Self {
        let path = root().join(name);
        fs::create_dir(&path).unwrap_or_else(|error| panic!("{}: {error}; is the name taken?", path.display()));
        Self(path)
    }

    /// An empty folder for the test `name`, once the shared dataset and model are there.
    pub fn with_model(name: &str) -> Self {
        train_shared_model();
        Self::new(name)
    }

    /// Runs `cnerf LINE` here; words are separated by white space.
    pub fn run(&self, line: &str) -> Run {
        let mut command = assert_cmd::Command::new(binary());
        let output = command.args(line.split_whitespace()).current_dir(&self.0).timeout(PATIENCE).output();
        let output = output.unwrap_or_else(|error| panic!("`cnerf {line}` cannot be run: {error}"));
        Run {
            command: line.to_owned(),
            code: output.status.code().unwrap_or(-1),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }

    /// `cnerf LINE`, ready to be started here and killed.
    pub fn command(&self, line: &str) -> Command {
        let mut command = Command::new(binary());
        command.args(line.split_whitespace()).current_dir(&self.0);
        command
    }

    /// Runs `cnerf LINE --json`, which must succeed, and returns what it printed.
    pub fn json(&self, line: &str) -> Value {
        self.run(&format!("{line} --json --quiet")).done().json()
    }

    /// Where `name` is.
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// The bytes of the file `name`.
    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap_or_else(|error| panic!("{}: {error}", self.path(name).display()))
    }

    /// Writes the file `name`.
    pub fn write(&self, name: &str, bytes: &[u8]) {
        fs::write(self.path(name), bytes).unwrap();
    }

    /// The picture `name`.
    pub fn picture(&self, name: &str) -> RgbImage {
        image::load_from_memory(&self.read(name)).unwrap_or_else(|error| panic!("{name}: {error}")).to_rgb8()
    }

    /// Names of what lies in `name`, hidden files too, sorted.
    pub fn list(&self, name: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(name)).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Copies the sample photo (an astronaut before a flag) here as `name`.
    pub fn photo(&self, name: &str) {
        let photo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/photos/astronaut.png");
        fs::copy(photo, self.path(name)).unwrap();
    }
}

/// The number under `key`; fails if it is none, or not finite (JSON has no such numbers: they become null).
pub fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("`{key}` is not a number in {value}"))
}

/// Whether a picture shows more than one flat colour.
pub fn has_content(picture: &RgbImage) -> bool {
    let (low, high) = picture.as_raw().iter().fold((255, 0), |(low, high), &v| (v.min(low), v.max(high)));
    high - low > 32
}

/// The folder that this test binary's folders are in, emptied when first asked for.
fn root() -> &'static Path {
    static ROOT: OnceLock<PathBuf> = OnceLock::new();
    ROOT.get_or_init(|| {
        let name = env::current_exe().unwrap().file_stem().unwrap().to_string_lossy().into_owned();
        let path = profile_folder().join("e2e").join(name);
        if path.exists() {
            fs::remove_dir_all(&path).unwrap();
        }
        fs::create_dir_all(&path).unwrap();
        path
    })
}

/// `target/release` or `target/debug`: test executables lie in its `deps`.
fn profile_folder() -> PathBuf {
    env::current_exe().unwrap().ancestors().nth(2).unwrap().to_owned()
}

/// The compiled `cnerf`: the one named by `CNERF_BIN`, else the one beside this test, built if it is not there.
fn binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| {
        if let Some(path) = env::var_os("CNERF_BIN") {
            return path.into();
        }
        let folder = profile_folder();
        let path = folder.join(format!("cnerf{}", env::consts::EXE_SUFFIX));
        if !path.exists() {
            let profile = match folder.file_name().unwrap().to_str().unwrap() {
                "debug" => "dev",
                other => other,
            };
            let mut cargo = Command::new(env!("CARGO"));
            cargo.args(["build", "--package", "cnerf", "--profile", profile, "--target-dir"]);
            cargo.arg(folder.parent().unwrap()).current_dir(env!("CARGO_MANIFEST_DIR"));
            assert!(cargo.status().unwrap().success(), "cnerf cannot be built");
        }
        path
    })
}

/// Draws the shared dataset and trains the shared model, stage by stage, once in a test binary.
fn train_shared_model() {
    static TRAINED: OnceLock<()> = OnceLock::new();
    TRAINED.get_or_init(|| {
        let folder = Folder::new("shared");
        folder.run("synth --count 24 --size 64 --seed 1 --out data").done();
        let tiny = "train --data data --preset tiny --seed 1 --quiet";
        folder.run(&format!("{tiny} --stage warmup --set warmup.steps=60 --out warmup")).done();
        let start = "--stage upsampler --model warmup/model.safetensors";
        folder.run(&format!("{tiny} {start} --set upsampler.steps=12 --out model")).done();
    });
}
