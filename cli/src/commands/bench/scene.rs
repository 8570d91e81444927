//! Which portrait is rendered, how large.

use candle_core::Device;
use clap::Args;
use cnerf_core::{
    bench::scene::{Scene, SceneKind},
    model::generator::Generator,
};

/// The model whose portrait is measured by default.
const DEFAULT_MODEL: &str = "portrait";

/// What is rendered.
#[derive(Args, Clone, Debug)]
pub struct SceneArguments {
    /// Whose portrait
    #[arg(long, value_enum, default_value = "model")]
    config: SceneKind,
    /// The model: `portrait` and `cartoon` are built in; else a file
    #[arg(long, value_name = "NAME|PATH")]
    model: Option<String>,
    /// Width and height of the render [default: the model's]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u16).range(1..=1024))]
    resolution: Option<u16>,
    /// Samples a ray [default: the model's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    samples: Option<u16>,
}

impl SceneArguments {
    /// The random portrait `seed`.
    pub fn scene(&self, seed: u64) -> anyhow::Result<Scene> {
        let scene = match self.config {
            SceneKind::Reference if self.model.is_some() => {
                anyhow::bail!("--model: `--config reference` has random weights; give one of the two");
            }
            SceneKind::Reference => Scene::reference(seed)?,
            SceneKind::Model => {
                let name = self.model.as_deref().unwrap_or(DEFAULT_MODEL);
                // The kernels under test are the processor's, so there is no choice of device.
                let generator = match cnerf_models::bytes(name) {
                    Some(bytes) => Generator::from_bytes(name.as_ref(), bytes, &Device::Cpu)?,
                    None => Generator::open(name.as_ref(), &Device::Cpu)?,
                };
                Scene::of_model(generator, name, seed)?
            }
        };
        Ok(scene.resized(self.resolution.map(usize::from), self.samples.map(usize::from))?)
    }
}
