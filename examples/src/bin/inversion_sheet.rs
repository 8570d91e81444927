//! A sheet to judge inversions by: a row for each person with photo, pivot, tuned portrait, both side views and edits
//! that take codes from the person in the next row. And a table of what the edits changed.
//!
//! Portrait files that `--out` holds already, of `cnerf invert --out DIR` or `cnerf eval inversion --portraits DIR`, are
//! taken as they are; people without one are inverted, and their portraits left there:
//!
//! `inversion_sheet --data portraits_valid.zip --count 12 --effort balanced --out DIR --sheet SHEET.png`

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use candle_core::{Device, Tensor};
use clap::Parser;
use cnerf_core::{
    camera::Camera, codes::Aspect, data::picture, interop::sheet::Sheet, model::generator::Generator, region::RegionSet,
};
use cnerf_invert::{
    config::InvertConfig,
    edit::{self, Change, Edit, Goal, Source},
    evaluation::{EvaluationOptions, Helpers, People},
    inverter::{Inverter, Opened},
    likeness::Likeness,
    parser::ParserConfig,
    portrait::{Deltas, Portrait},
    start::NearStart,
};
use image::RgbImage;

/// How far the side views are turned, radians.
const SIDE_RAD: f64 = 0.4;
/// Titles of the columns before the edits'.
const TITLES: [&str; 5] = ["photo", "pivot", "tuned", "-0.4 rad", "+0.4 rad"];

#[derive(Parser, Debug)]
#[command(about = "A sheet of inverted people: photo, pivot, tuned, side views, edits")]
struct Arguments {
    /// A data set (folder or zip; of several views of a head, the first is inverted), or a folder of photos
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// People, drawn by --seed as `cnerf eval inversion` draws them
    #[arg(long, default_value_t = 12, value_name = "N")]
    count: usize,
    /// Seed of every random draw
    #[arg(long, default_value_t = 0, value_name = "S")]
    seed: u64,
    /// Folder of the portraits, NAME.cnerf: those there are taken, the others are made
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The sheet to write
    #[arg(long, value_name = "FILE.png")]
    sheet: PathBuf,
    /// The last three columns: a region or several joined by +, and shape or texture (neither: both)
    #[arg(long, value_name = "R[:ASPECT]", value_delimiter = ',', value_parser = column, default_value = "hair:texture,hair:shape,mouth")]
    edits: Vec<Column>,
    /// The model: `portrait`, `cartoon` or a file
    #[arg(long, default_value = "portrait", value_name = "NAME|PATH")]
    model: String,
    /// LPIPS weights (safetensors) for a perceptual loss
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    #[command(flatten)]
    config: InvertConfig,
}

/// An edit, and its column's title.
#[derive(Clone, Debug)]
struct Column {
    title: String,
    regions: RegionSet,
    aspect: Aspect,
}

/// A person's row before the edits.
struct Person {
    name: String,
    photo: RgbImage,
    portrait: Portrait,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let model = match cnerf_models::bytes(&arguments.model) {
        Some(bytes) => Generator::from_bytes(arguments.model.as_ref(), bytes, &Device::Cpu)?,
        None => Generator::open(arguments.model.as_ref(), &Device::Cpu)?,
    };
    let people = People::open(&arguments.data, arguments.count, arguments.seed)?;
    let people = arguments.people(&model, &people)?;
    let titles = TITLES.into_iter().chain(arguments.edits.iter().map(|column| column.title.as_str()));
    let mut sheet = Sheet::with_titles(titles);
    for (index, person) in people.iter().enumerate() {
        let path = arguments.path(&person.name);
        for picture in looks(person, &path, &model)? {
            sheet = sheet.push(picture, "");
        }
        let donor = people.get((index + 1) % people.len()).filter(|_| people.len() > 1);
        let mut line = format!("{:<16} {:5.1} dB", person.name, person.portrait.metrics.psnr);
        for column in &arguments.edits {
            let (picture, change) = edited(person, &path, &model, donor, column, arguments.seed)?;
            sheet = sheet.push(picture, "");
            line += &format!(
                "  {}: {:.3} inside, {:.4} outside, depth {:.1e}",
                column.title, change.inside_change, change.outside_change, change.depth_change
            );
        }
        println!("{line}");
    }
    sheet.save(&arguments.sheet)?;
    Ok(())
}

impl Arguments {
    fn path(&self, name: &str) -> PathBuf {
        self.out.join(name).with_extension("cnerf")
    }

    /// Everybody with a portrait; those who cannot be inverted are told and left out.
    fn people(&self, model: &Generator, people: &People) -> Result<Vec<Person>> {
        let likeness = Likeness::load(self.lpips.as_deref(), cnerf_models::parser(), &Device::Cpu)?;
        let parser = ParserConfig::default().load(cnerf_models::parser())?;
        let near = cnerf_models::start(&self.model);
        let near = near.map(|bytes| NearStart::from_bytes(self.model.as_ref(), bytes)).transpose()?;
        let side = model.output_resolution() as u32;
        let mut found = Vec::with_capacity(people.len());
        for index in 0..people.len() {
            let input = people.name(index);
            let name = Path::new(&input).file_stem().context("a photo without a name")?.to_string_lossy().into_owned();
            let path = self.path(&name);
            let make = || -> Result<Person> {
                let known = path.exists();
                let helpers = match known {
                    // For the photo beside the portrait, nothing but its crop is needed.
                    true => Helpers::default(),
                    false => Helpers { likeness: Some(&likeness), parser: parser.as_deref(), near: near.as_ref() },
                };
                let subject = people.subject(index, side, helpers, &EvaluationOptions::default())?;
                let photo = subject.aligned.picture.clone();
                if known {
                    return Ok(Person { name: name.clone(), photo, portrait: Portrait::load(&path)? });
                }
                let config = InvertConfig { seed: self.seed, ..self.config.clone() };
                let mut inverter = Inverter::new(model, &self.model, subject, config, helpers.likeness)?;
                while inverter.step()?.is_some() {}
                let portrait = inverter.finish()?.portrait;
                eprintln!("{input}: {:.1} dB in {:.0} s", portrait.metrics.psnr, portrait.metrics.seconds);
                portrait.save(&path)?;
                Ok(Person { name: name.clone(), photo, portrait })
            };
            match make() {
                Ok(person) => found.push(person),
                Err(error) => eprintln!("{input}: {error:#}"),
            }
        }
        if found.is_empty() {
            bail!("{}: nobody in it could be inverted", self.data.display());
        }
        Ok(found)
    }
}

/// Photo, pivot, tuned, and both sides.
fn looks(person: &Person, path: &Path, model: &Generator) -> Result<Vec<RgbImage>> {
    let portrait = &person.portrait;
    let pivot = Portrait { deltas: Deltas::default(), tint: None, ..portrait.clone() };
    let tuned = Opened::new(portrait, path, model)?;
    let camera = portrait.camera;
    let turned = |turn: f64| Camera { azimuth_rad: camera.azimuth_rad + turn, ..camera };
    Ok(vec![
        person.photo.clone(),
        first(&Opened::new(&pivot, path, model)?.picture(&camera)?.rgb)?,
        first(&tuned.picture(&camera)?.rgb)?,
        first(&tuned.picture(&turned(-SIDE_RAD))?.rgb)?,
        first(&tuned.picture(&turned(SIDE_RAD))?.rgb)?,
    ])
}

/// The person after an edit with `donor`'s codes, those of a random portrait if there is nobody else; and what it changed.
fn edited(
    person: &Person,
    path: &Path,
    model: &Generator,
    donor: Option<&Person>,
    column: &Column,
    seed: u64,
) -> Result<(RgbImage, Change)> {
    let source = donor.map_or(Source::Seed(seed), |donor| Source::Portrait(donor.name.clone()));
    let goal = Goal::of(&source, model, donor.map(|donor| &donor.portrait), None)?;
    let edit = Edit { regions: column.regions, aspect: column.aspect, source, amount: 1.0 };
    let edited = edit::apply(&mut person.portrait.clone(), path, model, &[(edit, goal)])?;
    Ok((edited.after, edited.change))
}

fn first(rgb: &Tensor) -> Result<RgbImage> {
    picture::from_tensor(rgb)?.into_iter().next().context("nothing was rendered")
}

fn column(text: &str) -> Result<Column> {
    let (regions, aspect) = text.split_once(':').unwrap_or((text, "both"));
    let aspect = match aspect {
        "shape" => Aspect::Shape,
        "texture" => Aspect::Texture,
        "both" => Aspect::Both,
        other => bail!("`{other}` is no aspect: shape, texture or both"),
    };
    Ok(Column { title: text.replace(':', " "), regions: regions.replace('+', ",").parse()?, aspect })
}
