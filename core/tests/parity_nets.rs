//! Parity of the 2D networks with the authors' code, on the tensors of `shared/reference`.
//!
//! Folder: CNERF_REFERENCE, else `../shared/reference`; every `tiny_s*` in it is run. Relative L2 error against the
//! authors' float64 tensors where there are any: at most 1e-4 on values and 1e-3 on gradients (the original's own
//! float32 rounding reaches 2e-5 and 9e-5). Computed in f32, as users run it.

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use candle_core::{DType, Device, Tensor, Var, backprop::GradStore};
use cnerf_core::{
    codes,
    interop::{
        authors::permute_regions,
        authors_nets::{
            discriminator_config, discriminator_tensors, discriminator_weights, upsampler_config, upsampler_tensors,
            upsampler_weights,
        },
        torch::read_checkpoint,
    },
    model::{
        discriminator::{Discriminator, DiscriminatorKind, class_labels, select_masks},
        upsampler::{Noise, Upsampler, UpsamplerInput, stylegan2::StyleGan2Upsampler},
    },
    parameters::Parameters,
    region::Region,
    train::adversarial::{Auxiliary, PathLength, Pictures, R1Weights, discriminator_loss, generator_terms, r1},
};

const VALUES: f64 = 1e-4;
const GRADIENTS: f64 = 1e-3;

/// One seed's tensors.
struct Reference {
    name: String,
    folder: PathBuf,
    tensors: HashMap<String, Tensor>,
}

impl Reference {
    /// Runs `test` on every seed there is.
    fn for_each(test: impl Fn(&Reference)) {
        let folder = std::env::var_os("CNERF_REFERENCE").map_or_else(
            || Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/reference")).to_owned(),
            PathBuf::from,
        );
        let Ok(entries) = std::fs::read_dir(&folder) else {
            println!("skipped: no folder {}", folder.display());
            return;
        };
        let mut names: Vec<String> = entries
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .filter_map(|name| name.strip_suffix(".json").filter(|name| name.starts_with("tiny_s")).map(str::to_owned))
            .collect();
        names.sort();
        assert!(!names.is_empty(), "no tiny_s*.json in {}", folder.display());
        for name in names {
            let tensors = candle_core::safetensors::load(folder.join(format!("{name}.safetensors")), &Device::Cpu);
            test(&Reference { tensors: tensors.unwrap(), folder: folder.clone(), name });
        }
    }

    fn get(&self, name: &str) -> Tensor {
        self.tensors.get(name).unwrap_or_else(|| panic!("{}: no tensor {name}", self.name)).clone()
    }

    /// Masks or classes along `dimension`, in our order.
    fn regions(&self, name: &str, dimension: usize) -> Tensor {
        permute_regions(&self.get(name), dimension).unwrap()
    }

    /// The float64 tensor if there is one.
    fn truth(&self, name: &str) -> Tensor {
        self.tensors.get(&format!("f64/{name}")).cloned().unwrap_or_else(|| self.get(name))
    }

    /// One state dict of a checkpoint in the authors' layout.
    fn state(&self, file: &str, entry: &str) -> HashMap<String, Tensor> {
        let checkpoint = read_checkpoint(self.folder.join(format!("{}_{file}.pt", self.name))).unwrap();
        checkpoint.get(entry).unwrap().flatten().into_iter().collect()
    }

    /// Compares one tensor, prints a line, fails above `tolerance`.
    fn check(&self, name: &str, found: &Tensor, tolerance: f64) {
        self.compare(name, found, &self.truth(name), tolerance);
    }

    fn check_regions(&self, name: &str, found: &Tensor, dimension: usize, tolerance: f64) {
        self.compare(name, found, &permute_regions(&self.truth(name), dimension).unwrap(), tolerance);
    }

    fn compare(&self, name: &str, found: &Tensor, expected: &Tensor, tolerance: f64) {
        assert_eq!(found.dims(), expected.dims(), "{}: {name}", self.name);
        let error = relative_error(found, expected);
        println!("{} {name:<28} {error:.1e}", self.name);
        // Not `error > tolerance`: an error that is not a number must fail too.
        assert!(error <= tolerance, "{}: {name}: relative error {error:.2e} above {tolerance:.0e}", self.name);
    }

    /// Compares all gradients below `prefix`, brought under our names by `rename`, and prints the worst.
    fn check_gradients(
        &self,
        prefix: &str,
        parameters: &Parameters,
        gradients: &GradStore,
        rename: impl Fn(&HashMap<String, Tensor>) -> HashMap<String, Tensor>,
    ) {
        let below = |name: &String| Some((name.strip_prefix(prefix)?.to_owned(), self.truth(name)));
        let theirs: HashMap<String, Tensor> = self.tensors.keys().filter_map(below).collect();
        let mut expected = rename(&theirs);
        assert_eq!(expected.len(), theirs.len(), "{}: some of {prefix} went unread", self.name);
        let (mut worst, mut worst_name, count) = (0.0, String::new(), expected.len());
        for (name, variable) in parameters.variables() {
            let Some(expected) = expected.remove(&name) else { continue };
            let found = gradients.get(&variable).unwrap_or_else(|| panic!("{}: no gradient of {name}", self.name));
            let error = relative_error(found, &expected);
            assert!(error <= GRADIENTS, "{}: {prefix}{name}: relative error {error:.2e}", self.name);
            if error >= worst {
                (worst, worst_name) = (error, name);
            }
        }
        assert!(expected.is_empty(), "{}: unchecked gradients {:?}", self.name, expected.keys());
        println!("{} {:<28} {worst:.1e}  worst of {count}: {worst_name}", self.name, format!("{prefix}*"));
    }
}

fn relative_error(found: &Tensor, expected: &Tensor) -> f64 {
    let double = |tensor: &Tensor| tensor.to_dtype(DType::F64).unwrap();
    let norm = |tensor: &Tensor| tensor.sqr().unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap().sqrt();
    norm(&(double(found) - double(expected)).unwrap()) / norm(&double(expected)).max(1e-30)
}

fn upsampler(reference: &Reference) -> (StyleGan2Upsampler, Parameters) {
    let authors = reference.state("full_pipeline", "g");
    let config = upsampler_config(&authors).unwrap();
    let parameters = Parameters::loaded(upsampler_weights(&config, &authors).unwrap(), DType::F32, &Device::Cpu);
    let features = reference.get("in/feat_dec").dim(1).unwrap();
    let style_dim = reference.get("map/w").dim(1).unwrap();
    let Upsampler::StyleGan2(network) = Upsampler::new(&config, features, style_dim, &parameters).unwrap() else {
        panic!("the authors' upsampler is StyleGAN2");
    };
    (network, parameters)
}

fn upsampler_input(reference: &Reference) -> UpsamplerInput {
    let (batch, _, height, width) = reference.get("in/feat_dec").dims4().unwrap();
    UpsamplerInput {
        // The authors' decoder does not read the colour.
        colour: Tensor::zeros((batch, 3, height, width), DType::F32, &Device::Cpu).unwrap(),
        masks: reference.regions("in/seg_dec", 1),
        features: reference.get("in/feat_dec"),
        normal: None,
    }
}

#[test]
fn parity_of_the_upsampler() {
    Reference::for_each(|reference| {
        let (network, _) = upsampler(reference);
        let features = Var::from_tensor(&reference.get("in/feat_dec")).unwrap();
        let input = UpsamplerInput { features: features.as_tensor().clone(), ..upsampler_input(reference) };
        let w = Var::from_tensor(&reference.get("map/w")).unwrap();
        let latents = network.latents(&w).unwrap();
        reference.check("map/dec_w", &latents[0].squeeze(1).unwrap(), VALUES);
        reference.check("dec/latent", &Tensor::cat(&latents, 1).unwrap(), VALUES);
        reference.check("dec/feature_transfer", &network.transfer_features(&features).unwrap(), VALUES);
        let output = network.synthesize(&input, &latents, Noise::Stored).unwrap();
        reference.check("dec/rgb", &output.rgb, VALUES);
        reference.check_regions("dec/seg", &output.masks, 1, VALUES);

        let buffers: Vec<Tensor> =
            (0..latents.len() - 1).map(|layer| reference.get(&format!("in/noise_{layer}"))).collect();
        let given = network.synthesize(&input, &latents, Noise::Given(&buffers)).unwrap();
        reference.compare("dec/rgb (noise given)", &given.rgb, &reference.truth("dec/rgb"), VALUES);

        let difference = (output.rgb - reference.get("in/target_rgb")).unwrap();
        let on_masks = (output.masks.sqr().unwrap().mean_all().unwrap() * 0.1).unwrap();
        let loss = (difference.sqr().unwrap().mean_all().unwrap() + on_masks).unwrap();
        reference.check("dec/loss", &loss, VALUES);
        let gradients = loss.backward().unwrap();
        reference.check("dec/grad_w", gradients.get(&w).unwrap(), GRADIENTS);
        reference.check("dec/grad_feat", gradients.get(&features).unwrap(), GRADIENTS);
    });
}

#[test]
fn parity_of_mixed_and_truncated_styles() {
    Reference::for_each(|reference| {
        let (network, _) = upsampler(reference);
        let input = upsampler_input(reference);
        let latents = network.latents(&reference.get("map/w")).unwrap();
        let second = network.latents(&reference.get("map/w2")).unwrap();
        let mixed = StyleGan2Upsampler::mix(&latents, &second, 3);
        let output = network.synthesize(&input, &mixed, Noise::Stored).unwrap();
        reference.check("dec_mix/rgb", &output.rgb, VALUES);
        reference.check_regions("dec_mix/seg", &output.masks, 1, VALUES);

        let mean = reference.get("map/mean_dec");
        let truncate = |latent: &Tensor| codes::truncate(latent, &mean, 0.7).unwrap();
        let truncated: Vec<Tensor> = latents.iter().map(truncate).collect();
        let output = network.synthesize(&input, &truncated, Noise::Stored).unwrap();
        reference.check("dec_trunc/rgb", &output.rgb, VALUES);
        reference.check_regions("dec_trunc/seg", &output.masks, 1, VALUES);
    });
}

#[test]
fn parity_of_path_length_regularisation() {
    Reference::for_each(|reference| {
        let (network, parameters) = upsampler(reference);
        let input = upsampler_input(reference);
        let latents = network.latents(&reference.get("map/w")).unwrap();
        let features = network.transfer_features(&input.features).unwrap();
        let (_, trace) = network.synthesize_from(&features, &input.masks, &latents, Noise::Stored).unwrap();
        let noise = reference.get("in/ppl_noise");
        let (_, _, height, width) = noise.dims4().unwrap();
        let noise = (noise / ((height * width) as f64).sqrt()).unwrap();
        let gradient = network.latent_gradient(&trace, &noise).unwrap();
        reference.check("ppl/grad_latents", &Tensor::cat(&gradient, 1).unwrap(), GRADIENTS);
        let previous_mean = Tensor::new(0f32, &Device::Cpu).unwrap();
        let path = PathLength::new(&gradient, &previous_mean, 0.01).unwrap();
        reference.check("ppl/lengths", &path.lengths, VALUES);
        reference.check("ppl/mean", &path.mean, VALUES);
        reference.check("ppl/penalty", &path.penalty, VALUES);
        let config = upsampler_config(&reference.state("full_pipeline", "g")).unwrap();
        reference.check_gradients("ppl/grad/", &parameters, &path.penalty.backward().unwrap(), |theirs| {
            upsampler_tensors(&config, theirs).unwrap()
        });
    });
}

/// A discriminator with the authors' weights.
fn discriminator(reference: &Reference, kind: DiscriminatorKind) -> (Discriminator, Parameters) {
    let authors = match kind {
        DiscriminatorKind::Global => reference.state("vol_renderer", "gd"),
        DiscriminatorKind::Semantic => reference.state("vol_renderer", "sd"),
        DiscriminatorKind::HighResolution => reference.state("full_pipeline", "d"),
    };
    let config = discriminator_config(kind, &authors).unwrap();
    let parameters = Parameters::loaded(discriminator_weights(&config, &authors).unwrap(), DType::F32, &Device::Cpu);
    (Discriminator::new(&config, &parameters).unwrap(), parameters)
}

/// What all three discriminators share: predictions, explicit and automatic input gradients, R1, the whole loss and its
/// gradients.
fn check_discriminator(
    reference: &Reference,
    prefix: &str,
    kind: DiscriminatorKind,
    [real_image, real_masks, fake_image, fake_masks]: [Tensor; 4],
    auxiliary: Auxiliary<'_>,
    penalty: R1Weights,
) {
    let (network, parameters) = discriminator(reference, kind);
    let name = |rest: &str| format!("{prefix}/{rest}");
    let (real_image, real_masks) = (Var::from_tensor(&real_image).unwrap(), Var::from_tensor(&real_masks).unwrap());
    let (real, explicit) = network.forward_with_input_gradients(&real_image, &real_masks).unwrap();
    let fake = network.forward(&fake_image, &fake_masks).unwrap();
    for (judgement, which) in [(&real, "real"), (&fake, "fake")] {
        reference.check(&name(&format!("{which}_pred")), &judgement.realness, VALUES);
        if let Some(view) = &judgement.view {
            reference.check(&name(&format!("{which}_view")), view, VALUES);
        }
        if let Some(class) = &judgement.class {
            reference.check_regions(&name(&format!("{which}_class")), class, 1, VALUES);
        }
    }
    let automatic = real.realness.sum_all().unwrap().backward().unwrap();
    for (image, masks) in
        [(&explicit.image, &explicit.masks), (automatic.get(&real_image).unwrap(), automatic.get(&real_masks).unwrap())]
    {
        reference.check(&name("grad_img"), image, GRADIENTS);
        match kind {
            DiscriminatorKind::Semantic => reference.check(&name("grad_mask"), masks, GRADIENTS),
            _ => reference.check_regions(&name("grad_mask"), masks, 1, GRADIENTS),
        }
    }
    reference.check(&name("r1_img"), &r1(&explicit.image).unwrap(), GRADIENTS);
    reference.check(&name("r1_mask"), &r1(&explicit.masks).unwrap(), GRADIENTS);

    let loss = discriminator_loss(
        &network,
        Pictures { image: &real_image.as_detached_tensor(), masks: &real_masks.as_detached_tensor() },
        Pictures { image: &fake_image, masks: &fake_masks },
        auxiliary,
        Some(penalty),
    )
    .unwrap();
    for (part, found) in
        [("logistic", Some(&loss.logistic)), ("view", loss.auxiliary.as_ref()), ("classify", loss.auxiliary.as_ref())]
    {
        if let Some(found) = found.filter(|_| reference.tensors.contains_key(&name(part))) {
            reference.check(&name(part), found, VALUES);
        }
    }
    reference.check(&name("total"), &loss.total, VALUES);
    reference.check_gradients(&name("grad/"), &parameters, &loss.total.backward().unwrap(), |theirs| {
        discriminator_tensors(network.config(), theirs).unwrap()
    });
}

const PENALTY: R1Weights = R1Weights { image: 10.0, masks: 1000.0 };

#[test]
fn parity_of_the_global_discriminator() {
    Reference::for_each(|reference| {
        let pictures = [
            reference.get("in/d_img"),
            reference.regions("in/d_mask", 1),
            reference.get("in/d_img2"),
            reference.regions("in/d_mask2", 1),
        ];
        let angles_rad = reference.get("in/d_view");
        let view = Auxiliary::View { angles_rad: &angles_rad, weight: 15.0 };
        check_discriminator(reference, "gd", DiscriminatorKind::Global, pictures, view, PENALTY);
    });
}

/// The authors' labels as regions.
fn regions_of(labels: &Tensor) -> Vec<Region> {
    let ours = [0, 1, 2, 4, 3, 5, 6, 7, 8];
    let labels = labels.to_dtype(DType::I64).unwrap().to_vec1::<i64>().unwrap();
    labels.into_iter().map(|label| Region::from_label(ours[label as usize]).unwrap()).collect()
}

#[test]
fn parity_of_the_semantic_discriminator() {
    Reference::for_each(|reference| {
        let regions = regions_of(&reference.get("in/d_label"));
        let pictures = [
            reference.get("in/d_img"),
            select_masks(&reference.regions("in/d_mask", 1), &regions).unwrap(),
            reference.get("in/d_img2"),
            select_masks(&reference.regions("in/d_mask2", 1), &regions).unwrap(),
        ];
        let labels = class_labels(&regions, &Device::Cpu).unwrap();
        let class = Auxiliary::Class { labels: &labels, weight: 1.0 };
        check_discriminator(reference, "sd", DiscriminatorKind::Semantic, pictures, class, PENALTY);
    });
}

#[test]
fn parity_of_the_high_resolution_discriminator() {
    Reference::for_each(|reference| {
        let pictures = [
            reference.get("in/D_img"),
            reference.regions("in/D_mask", 1),
            reference.get("in/D_img2"),
            reference.regions("in/D_mask2", 1),
        ];
        let (kind, penalty) = (DiscriminatorKind::HighResolution, PENALTY.every(16));
        check_discriminator(reference, "d", kind, pictures, Auxiliary::None, penalty);

        // The second stage's generator loss, from the authors' own pictures.
        let (network, _) = discriminator(reference, kind);
        let (image, masks) = (reference.truth("plain/rgb"), reference.truth("plain/seg_high"));
        let single = |tensor: &Tensor| tensor.to_dtype(DType::F32).unwrap();
        let masks = permute_regions(&masks, 1).unwrap();
        let pictures = Pictures { image: &single(&image), masks: &single(&masks) };
        reference.check("g2/loss", &generator_terms(&network, pictures, Auxiliary::None).unwrap().total, VALUES);
    });
}
