//! The authors' upsampler and discriminators under our names: which of their tensors each of ours comes from, and the
//! reordering of regions (their data code stacks the mouth as 3 and the eyebrows as 4).

use std::collections::HashMap;

use candle_core::Tensor;

use super::authors::permute_regions;
use crate::{
    config::{UpsamplerConfig, UpsamplerKind, UpsamplerStyle},
    error::{Error, Result},
    model::discriminator::{DiscriminatorConfig, DiscriminatorKind},
};

/// The configuration of the upsampler in a generator's state dict `authors`, read off its tensors' shapes.
///
/// # Errors
/// [`Error::Shape`] naming the tensor that is missing or has another rank (a stage-1 checkpoint has no upsampler).
pub fn upsampler_config(authors: &HashMap<String, Tensor>) -> Result<UpsamplerConfig> {
    let find = |name: &str| {
        let missing = || Error::shape(name, "a tensor of this name in the checkpoint", &[]);
        authors.get(name).ok_or_else(missing)
    };
    let (_, _, input_resolution, _) = find("decoder.noises.noise_0")?.dims4()?;
    let (latent_dim, _) = find("decoder.style.1.weight")?.dims2()?;
    let mut channels = Vec::new();
    while let Some(weight) = authors.get(&format!("{}.conv.weight", numbered("decoder.to_rgb", channels.len()))) {
        let (_, _, inputs, _, _) = weight.dims5()?;
        channels.push(inputs);
    }
    let style_layers = (1..).take_while(|layer| authors.contains_key(&format!("decoder.style.{layer}.weight"))).count();
    Ok(UpsamplerConfig {
        kind: UpsamplerKind::StyleGan2,
        style: UpsamplerStyle::Global,
        input_resolution,
        output_resolution: input_resolution << channels.len().saturating_sub(1),
        channels,
        style_layers,
        latent_dim,
        blocks: Vec::new(),
        normal_input: false,
    })
}

/// The configuration of a discriminator (`gd`, `sd` or `d`), read off its tensors.
///
/// # Errors
/// [`Error::Shape`] when the tensors are not those of a discriminator.
pub fn discriminator_config(kind: DiscriminatorKind, authors: &HashMap<String, Tensor>) -> Result<DiscriminatorConfig> {
    let conv1 = if kind == DiscriminatorKind::HighResolution { "conv1.0.weight" } else { "conv1.conv.conv.weight" };
    let blocks = (1..).take_while(|block| authors.contains_key(&format!("convs_img.{block}.{conv1}"))).count();
    let (smallest, full) = if kind == DiscriminatorKind::Global { (2, 400.0) } else { (4, 512.0) };
    let last = if kind == DiscriminatorKind::HighResolution { "final_conv.0.weight" } else { "final_conv.conv.weight" };
    let found = authors.get(last).ok_or_else(|| Error::shape(last, "a tensor of this name in the checkpoint", &[]))?;
    let (_, features, _, _) = found.dims4()?;
    // One channel is the minibatch deviation.
    let channel_multiplier = (features - 1) as f64 / full;
    Ok(DiscriminatorConfig { kind, resolution: smallest << blocks, channel_multiplier })
}

/// Where one of our tensors comes from.
struct Source {
    ours: String,
    authors: String,
    /// Dimension of ours that counts regions.
    regions: Option<usize>,
}

/// The upsampler of a generator's state dict `authors` (names as in `g_ema`: `feature_transfer.*`, `decoder.*`), named as
/// [`crate::model::upsampler::stylegan2`] names its weights.
///
/// # Errors
/// [`Error::Shape`] naming the tensor that is missing.
pub fn upsampler_weights(
    config: &UpsamplerConfig,
    authors: &HashMap<String, Tensor>,
) -> Result<HashMap<String, Tensor>> {
    convert(&upsampler_sources(config), authors)
}

/// Gradients or other tensors in the upsampler's weights' places; ones that `authors` lacks are left out.
pub fn upsampler_tensors(
    config: &UpsamplerConfig,
    authors: &HashMap<String, Tensor>,
) -> Result<HashMap<String, Tensor>> {
    convert(&present(upsampler_sources(config), authors), authors)
}

/// A discriminator of the authors' (`gd`, `sd` or `d`), named as [`crate::model::discriminator`] names its weights.
///
/// # Errors
/// [`Error::Shape`] naming the tensor that is missing.
pub fn discriminator_weights(
    config: &DiscriminatorConfig,
    authors: &HashMap<String, Tensor>,
) -> Result<HashMap<String, Tensor>> {
    convert(&present_skips(discriminator_sources(config), authors), authors)
}

/// Gradients or other tensors in the discriminator's weights' places; ones that `authors` lacks are left out.
pub fn discriminator_tensors(
    config: &DiscriminatorConfig,
    authors: &HashMap<String, Tensor>,
) -> Result<HashMap<String, Tensor>> {
    convert(&present(discriminator_sources(config), authors), authors)
}

fn present(sources: Vec<Source>, authors: &HashMap<String, Tensor>) -> Vec<Source> {
    sources.into_iter().filter(|source| authors.contains_key(&source.authors)).collect()
}

/// Skip convolutions exist only where the number of channels changes.
fn present_skips(sources: Vec<Source>, authors: &HashMap<String, Tensor>) -> Vec<Source> {
    let needed = |source: &Source| !source.ours.contains(".skip.") || authors.contains_key(&source.authors);
    sources.into_iter().filter(needed).collect()
}

fn convert(sources: &[Source], authors: &HashMap<String, Tensor>) -> Result<HashMap<String, Tensor>> {
    let one = |source: &Source| {
        let Some(tensor) = authors.get(&source.authors) else {
            return Err(Error::shape(source.authors.clone(), "a tensor of this name in the checkpoint", &[]));
        };
        let tensor = match tensor.dims() {
            // Weights of modulated convolutions and biases of pictures carry a batch dimension of 1.
            [1, _, _, _, _] => tensor.squeeze(0)?,
            [1, _, 1, 1] if source.ours.ends_with("bias") => tensor.flatten_all()?,
            _ => tensor.clone(),
        };
        let tensor = match source.regions {
            Some(dimension) => permute_regions(&tensor, dimension)?,
            None => tensor,
        };
        Ok((source.ours.clone(), tensor))
    };
    sources.iter().map(one).collect()
}

#[derive(Default)]
struct Sources(Vec<Source>);

impl Sources {
    fn add(&mut self, ours: impl Into<String>, authors: impl Into<String>, regions: Option<usize>) {
        self.0.push(Source { ours: ours.into(), authors: authors.into(), regions });
    }

    fn linear(&mut self, ours: &str, authors: &str) {
        for name in ["weight", "bias"] {
            self.add(format!("{ours}.{name}"), format!("{authors}.{name}"), None);
        }
    }
}

fn upsampler_sources(config: &UpsamplerConfig) -> Vec<Source> {
    let mut sources = Sources::default();
    sources.add("feature_transfer.weight", "feature_transfer.0.weight", None);
    sources.add("feature_transfer.bias", "feature_transfer.1.bias", None);
    for layer in 0..config.style_layers {
        // Their layer 0 is PixelNorm.
        sources.linear(&format!("style.{layer}"), &format!("decoder.style.{}", layer + 1));
    }
    let levels = config.channels.len();
    for layer in 0..2 * levels.saturating_sub(1) + 1 {
        let (ours, authors) = (format!("layer.{layer}"), numbered("decoder.conv", layer));
        sources.add(format!("{ours}.weight"), format!("{authors}.conv.weight"), None);
        sources.linear(&format!("{ours}.modulation"), &format!("{authors}.conv.modulation"));
        sources.add(format!("{ours}.noise_strength"), format!("{authors}.noise.weight"), None);
        sources.add(format!("{ours}.noise"), format!("decoder.noises.noise_{layer}"), None);
        sources.add(format!("{ours}.bias"), format!("{authors}.activate.bias"), None);
    }
    for level in 0..levels {
        for (ours, authors, regions) in [("to_rgb", "to_rgb", None), ("to_masks", "to_seg", Some(0))] {
            let (ours, authors) = (format!("{ours}.{level}"), numbered(&format!("decoder.{authors}"), level));
            sources.add(format!("{ours}.weight"), format!("{authors}.conv.weight"), regions);
            sources.linear(&format!("{ours}.modulation"), &format!("{authors}.conv.modulation"));
            sources.add(format!("{ours}.bias"), format!("{authors}.bias"), regions);
        }
    }
    sources.0
}

/// The authors keep the first of a series apart: `conv1`, then `convs.0`, `convs.1`, ….
fn numbered(name: &str, index: usize) -> String {
    match index.checked_sub(1) {
        None => format!("{name}1"),
        Some(index) => format!("{name}s.{index}"),
    }
}

fn discriminator_sources(config: &DiscriminatorConfig) -> Vec<Source> {
    let mut sources = Sources::default();
    let high_resolution = config.kind == DiscriminatorKind::HighResolution;
    let smallest = if config.kind == DiscriminatorKind::Global { 2 } else { 4 };
    let blocks = (config.resolution / smallest).max(1).ilog2();
    for (ours, authors) in [("image", "convs_img"), ("masks", "convs_seg")] {
        let regions = (ours == "masks" && config.kind != DiscriminatorKind::Semantic).then_some(1);
        let (weight, bias) = match (config.kind, ours) {
            (DiscriminatorKind::HighResolution, _) => ("0.weight", "1.bias"),
            (DiscriminatorKind::Semantic, "masks") => ("conv.weight", "conv.bias"),
            _ => ("conv.weight", "activation.bias"),
        };
        sources.add(format!("{ours}.first.weight"), format!("{authors}.0.{weight}"), regions);
        sources.add(format!("{ours}.first.bias"), format!("{authors}.0.{bias}"), None);
        for block in 0..blocks {
            let (ours, authors) = (format!("{ours}.block.{block}"), format!("{authors}.{}", block + 1));
            let names = if high_resolution {
                // Their second convolution and skip have a blur kernel in front.
                [
                    ["conv1.0.weight", "conv1.1.bias"],
                    ["conv2.1.weight", "conv2.2.bias"],
                    ["skip.1.weight", "skip.1.bias"],
                ]
            } else {
                [
                    ["conv1.conv.conv.weight", "conv1.activation.bias"],
                    ["conv2.conv.conv.weight", "conv2.activation.bias"],
                    ["skip.conv.weight", "skip.conv.bias"],
                ]
            };
            for (part, [weight, bias]) in ["first", "second", "skip"].into_iter().zip(names) {
                sources.add(format!("{ours}.{part}.weight"), format!("{authors}.{weight}"), None);
                sources.add(format!("{ours}.{part}.bias"), format!("{authors}.{bias}"), None);
            }
        }
    }
    let (weight, bias) = if high_resolution { ("0.weight", "1.bias") } else { ("conv.weight", "conv.bias") };
    sources.add("last.weight", format!("final_conv.{weight}"), None);
    sources.add("last.bias", format!("final_conv.{bias}"), None);
    if config.kind != DiscriminatorKind::Global {
        sources.linear("realness.0", "final_linear.0");
        sources.linear("realness.1", "final_linear.1");
    }
    if config.kind == DiscriminatorKind::Semantic {
        sources.linear("class.0", "class_linear.0");
        sources.add("class.1.weight", "class_linear.1.weight", Some(0));
        sources.add("class.1.bias", "class_linear.1.bias", Some(0));
    }
    sources.0
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;
    use crate::{
        model::{discriminator::Discriminator, upsampler::Upsampler},
        parameters::Parameters,
    };

    /// Every weight a network of ours asks for has a source, and no source is left over.
    fn assert_complete(parameters: &Parameters, sources: Vec<Source>) {
        let mut ours: Vec<_> = parameters.variables().into_iter().map(|(name, _)| name).collect();
        let mut named: Vec<_> = sources.into_iter().map(|source| source.ours).collect();
        ours.sort();
        named.sort();
        assert_eq!(ours, named);
    }

    #[test]
    fn every_weight_has_one_source() {
        let config = UpsamplerConfig { channels: vec![8, 6, 4], output_resolution: 256, ..UpsamplerConfig::paper(8) };
        let parameters = Parameters::fresh(0, DType::F32, &Device::Cpu);
        Upsampler::new(&config, 5, 8, &parameters).unwrap();
        assert_complete(&parameters, upsampler_sources(&config));
        for kind in [DiscriminatorKind::Global, DiscriminatorKind::Semantic, DiscriminatorKind::HighResolution] {
            let config = DiscriminatorConfig { kind, resolution: 64, channel_multiplier: 0.02 };
            let parameters = Parameters::fresh(0, DType::F32, &Device::Cpu);
            Discriminator::new(&config, &parameters).unwrap();
            let ours: Vec<_> = parameters.variables().into_iter().map(|(name, _)| name).collect();
            let sources = discriminator_sources(&config);
            let skip = |source: &Source| source.ours.contains(".skip.") && !ours.contains(&source.ours);
            assert_complete(&parameters, sources.into_iter().filter(|source| !skip(source)).collect());
        }
    }
}
