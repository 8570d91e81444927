//! The authors' checkpoints as weights of this suite: names, stacking over regions, and their order of regions.

use std::collections::HashMap;

use candle_core::{D, DType, Device, Tensor};

use crate::{
    config::{FILM_LAYERS, FieldConfig, FilmConfig, InitialDistance, SHAPE_LAYERS, SdfHead},
    error::{Error, Result},
    model::mapping::MAPPING_LAYERS,
    region::{REGION_COUNT, Region},
};

/// The regions in the order the authors' data code stacks them: mouth before eyebrows (their names and README say
/// otherwise). Networks, codes and masks of their checkpoints are in this order.
pub const AUTHORS_ORDER: [Region; REGION_COUNT] = [
    Region::Background,
    Region::Face,
    Region::Eyes,
    Region::Mouth,
    Region::Eyebrows,
    Region::Nose,
    Region::Ears,
    Region::Hair,
    Region::Neck,
];

/// For every region in this suite's order, its place in the authors'. The permutation is its own inverse, so it
/// serves both ways.
pub fn authors_places() -> [usize; REGION_COUNT] {
    let mut places = [0; REGION_COUNT];
    for (place, region) in AUTHORS_ORDER.into_iter().enumerate() {
        places[region.index()] = place;
    }
    places
}

/// `tensor` with the regions of `dimension` (9 long) put from the authors' order into ours, or back.
pub fn permute_regions(tensor: &Tensor, dimension: usize) -> Result<Tensor> {
    if tensor.dims().get(dimension) != Some(&REGION_COUNT) {
        return Err(Error::shape("regions", REGION_COUNT, tensor.dims()));
    }
    let places = authors_places().map(|place| place as u32);
    Ok(tensor.contiguous()?.index_select(&Tensor::new(&places, tensor.device())?, dimension)?)
}

/// The authors' codes `[B, 18, D]` (row 2i shape of region i, row 2i + 1 its texture) as ours, `[B, 9, 2, D]`.
pub fn codes_from_authors(codes: &Tensor) -> Result<Tensor> {
    let (batch, _, style_dim) = codes.dims3()?;
    permute_regions(&codes.reshape((batch, REGION_COUNT, 2, style_dim))?, 1)
}

/// Our codes `[B, 9, 2, D]` as the authors', `[B, 18, D]`.
pub fn codes_to_authors(codes: &Tensor) -> Result<Tensor> {
    let (batch, _, _, style_dim) = codes.dims4()?;
    Ok(permute_regions(codes, 1)?.reshape((batch, 2 * REGION_COUNT, style_dim))?)
}

/// The authors' field and mapping network from the tensors of one generator's state dict (`g` or `g_ema`; names
/// `renderer.network.{i}.…`, `renderer.init_network.…`, `renderer.sigmoid_beta`, `style.{i}.…`).
///
/// The weights are called as [`crate::model::field::Field`] calls them below `field.`, and `mapping.{layer}.weight`
/// and `.bias`; f32, on the CPU. Errs, naming the tensor, if one is missing or has another shape.
pub fn import_authors_field(state: &HashMap<String, Tensor>) -> Result<(FieldConfig, HashMap<String, Tensor>)> {
    let source = Source(state);
    let (width, style_dim) = match source.get("renderer.network.0.shape_linears.0.gamma.weight")?.dims() {
        [width, style_dim] => (*width, *style_dim),
        other => return Err(Error::shape("renderer.network.0.shape_linears.0.gamma.weight", "[W, D]", other)),
    };
    let mut weights = HashMap::new();
    let networks = authors_places().map(|place| format!("renderer.network.{place}"));
    source.generators(&networks, "field", &mut weights)?;
    source.generators(&["renderer.init_network".to_owned()], "field.initial", &mut weights)?;
    for (theirs, ours) in [("mask_linears", "mask"), ("feature_linear", "feature"), ("rgb_linear", "colour")] {
        source.linear(&networks, theirs, &format!("field.{ours}"), &mut weights)?;
    }
    // Their positive parameter itself is learnt; ours is its logarithm.
    let beta = source.get("renderer.sigmoid_beta")?.reshape(1)?;
    let beta: f32 = beta.get(0)?.to_scalar()?;
    if !(beta > 0.0 && beta.is_finite()) {
        return Err(Error::not_finite(format!("logarithm of renderer.sigmoid_beta = {beta}")));
    }
    let log_alpha = Tensor::new(&[f64::from(beta).ln()], &Device::Cpu)?.to_dtype(DType::F32)?;
    weights.insert("field.log_alpha".to_owned(), log_alpha);
    for layer in 0..MAPPING_LAYERS {
        for part in ["weight", "bias"] {
            let tensor = source.get(&format!("style.{layer}.{part}"))?;
            weights.insert(format!("mapping.{layer}.{part}"), tensor);
        }
    }
    let config = FieldConfig {
        style_dim,
        width,
        film: FilmConfig { gamma_gain: 15.0, gamma_offset: 30.0, beta_gain: 0.25 },
        sdf_head: SdfHead::Texture,
        initial_distance: InitialDistance::Network,
        ..FieldConfig::paper()
    };
    Ok((config, weights))
}

struct Source<'a>(&'a HashMap<String, Tensor>);

impl Source<'_> {
    fn get(&self, name: &str) -> Result<Tensor> {
        let tensor = self.0.get(name).ok_or_else(|| {
            Error::config("checkpoint", format!("no tensor {name}: this is not a generator of the authors' code"))
        })?;
        Ok(tensor.to_device(&Device::Cpu)?.to_dtype(DType::F32)?)
    }

    fn stack(&self, networks: &[String], name: &str) -> Result<Tensor> {
        let tensors = networks.iter().map(|network| self.get(&format!("{network}.{name}")));
        Ok(Tensor::stack(&tensors.collect::<Result<Vec<_>>>()?, 0)?)
    }

    fn linear(
        &self,
        networks: &[String],
        theirs: &str,
        ours: &str,
        weights: &mut HashMap<String, Tensor>,
    ) -> Result<()> {
        for part in ["weight", "bias"] {
            weights.insert(format!("{ours}.{part}"), self.stack(networks, &format!("{theirs}.{part}"))?);
        }
        Ok(())
    }

    /// FiLM-SIREN layers and the distance head, stacked over `networks`.
    fn generators(&self, networks: &[String], prefix: &str, weights: &mut HashMap<String, Tensor>) -> Result<()> {
        let layers: Vec<String> = (0..FILM_LAYERS)
            .map(|layer| match layer.checked_sub(SHAPE_LAYERS) {
                None => format!("shape_linears.{layer}"),
                Some(layer) => format!("texture_linears.{layer}"),
            })
            .collect();
        for (index, layer) in layers.iter().enumerate() {
            for part in ["weight", "bias"] {
                let tensor = self.stack(networks, &format!("{layer}.{part}"))?;
                weights.insert(format!("{prefix}.{part}{}", index + 1), tensor);
            }
        }
        for (part, rank) in [("weight", 2), ("bias", 1)] {
            let film = layers
                .iter()
                .map(|layer| {
                    let gamma = self.stack(networks, &format!("{layer}.gamma.{part}"))?;
                    let beta = self.stack(networks, &format!("{layer}.beta.{part}"))?;
                    Ok(Tensor::cat(&[gamma, beta], if rank == 2 { D::Minus2 } else { D::Minus1 })?)
                })
                .collect::<Result<Vec<_>>>()?;
            weights.insert(format!("{prefix}.film.{part}"), Tensor::stack(&film, 1)?);
        }
        self.linear(networks, "sdf_linear", &format!("{prefix}.residual"), weights)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_round_trip_and_their_mouth_is_our_mouth() {
        let theirs = Tensor::arange(0f32, 18.0, &Device::Cpu).unwrap().reshape((1, 18, 1)).unwrap();
        let ours = codes_from_authors(&theirs).unwrap();
        let value = |region: Region, row: usize| {
            ours.get(0).unwrap().get(region.index()).unwrap().get(row).unwrap().to_vec1::<f32>().unwrap()[0]
        };
        assert_eq!((value(Region::Mouth, 0), value(Region::Eyebrows, 1), value(Region::Neck, 1)), (6.0, 9.0, 17.0));
        let back = codes_to_authors(&ours).unwrap();
        assert_eq!(back.to_vec3::<f32>().unwrap(), theirs.to_vec3::<f32>().unwrap());
    }

    #[test]
    fn a_missing_tensor_is_named() {
        let error = import_authors_field(&HashMap::new()).unwrap_err().to_string();
        assert!(error.contains("renderer.network.0.shape_linears.0.gamma.weight"), "{error}");
    }
}
