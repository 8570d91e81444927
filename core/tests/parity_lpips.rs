//! LPIPS against values computed in float64 with the original weights (`weights/lpips_check.safetensors`).

use std::path::PathBuf;

use candle_core::{DType, Device, Tensor, Var};
use cnerf_core::eval::perceptual::{Backbone, Perceptual};

fn weights() -> Option<PathBuf> {
    let shared = std::env::var_os("CNERF_REFERENCE").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")),
        |reference| PathBuf::from(reference).join(".."),
    );
    let folder = shared.join("weights");
    if folder.join("lpips_check.safetensors").exists() {
        return Some(folder);
    }
    println!("skipped: {} holds no lpips_check.safetensors", folder.display());
    None
}

#[test]
fn parity_of_lpips_values() {
    let Some(folder) = weights() else { return };
    let check = candle_core::safetensors::load(folder.join("lpips_check.safetensors"), &Device::Cpu).unwrap();
    for (file, key, backbone) in [("lpips_alexnet", "alex", Backbone::AlexNet), ("lpips_vgg16", "vgg", Backbone::Vgg16)]
    {
        let perceptual = Perceptual::load(folder.join(file).with_extension("safetensors"), &Device::Cpu).unwrap();
        assert_eq!(perceptual.backbone(), backbone);
        let expected: Vec<f64> = check[key].to_vec1().unwrap();
        let start = std::time::Instant::now();
        let found: Vec<f32> = perceptual.distance(&check["a"], &check["b"]).unwrap().to_vec1().unwrap();
        let seconds = start.elapsed().as_secs_f64();
        let error = found.iter().zip(&expected).map(|(found, expected)| (f64::from(*found) - expected).abs());
        let error = error.fold(0.0, f64::max);
        println!("{file}: largest error {error:.1e} of {expected:?}; {seconds:.2} s for 3 pairs at 128²");
        assert!(error <= 1e-4);
        // A picture has no distance to itself.
        let zero: Vec<f32> = perceptual.distance(&check["a"], &check["a"]).unwrap().to_vec1().unwrap();
        assert!(zero.iter().all(|&distance| distance == 0.0));
    }
}

#[test]
fn parity_of_lpips_gradients_with_finite_differences() {
    let Some(folder) = weights() else { return };
    let check = candle_core::safetensors::load(folder.join("lpips_check.safetensors"), &Device::Cpu).unwrap();
    // Small crops in f64, where the difference quotient is exact to about 1e-7.
    for (file, side) in [("lpips_alexnet", 64), ("lpips_vgg16", 32)] {
        let perceptual = Perceptual::load(folder.join(file).with_extension("safetensors"), &Device::Cpu).unwrap();
        let exact = perceptual.to_dtype(DType::F64).unwrap();
        let crop = |name: &str| {
            let crop = check[name].narrow(0, 0, 1).unwrap().narrow(2, 32, side).unwrap().narrow(3, 32, side).unwrap();
            crop.contiguous().unwrap()
        };
        let (a, b) = (crop("a"), crop("b").to_dtype(DType::F64).unwrap());
        let variable = Var::from_tensor(&a).unwrap();
        let gradients = perceptual.distance(&variable, &b.to_dtype(DType::F32).unwrap()).unwrap().backward().unwrap();
        let gradient = gradients.get(&variable).unwrap().to_dtype(DType::F64).unwrap();
        // Along the gradient itself and along two fixed other directions.
        let a = a.to_dtype(DType::F64).unwrap();
        let length = gradient.sqr().unwrap().sum_all().unwrap().sqrt().unwrap();
        let target = exact.features(&b).unwrap();
        for (name, direction) in [
            ("gradient", gradient.broadcast_div(&length).unwrap()),
            ("picture", (&a / (a.elem_count() as f64).sqrt()).unwrap()),
            ("ones", Tensor::ones(a.dims(), DType::F64, &Device::Cpu).unwrap().affine(0.01, 0.0).unwrap()),
        ] {
            let moved = |step: f64| {
                let moved = (&a + direction.affine(step, 0.0).unwrap()).unwrap();
                let features = exact.features(&moved).unwrap();
                exact.feature_distance(&features, &target).unwrap().to_vec1::<f64>().unwrap()[0]
            };
            // Longer steps cross kinks of ReLUs and maxima.
            let difference = (moved(1e-7) - moved(-1e-7)) / 2e-7;
            let product = (&gradient * &direction).unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap();
            println!("{file} along {name}: {product:.6e}, finite differences {difference:.6e}");
            let norm = |tensor: &Tensor| tensor.sqr().unwrap().sum_all().unwrap().sqrt().unwrap();
            let scale = (norm(&gradient) * norm(&direction)).unwrap().to_scalar::<f64>().unwrap();
            assert!((product - difference).abs() <= 1e-5 * scale, "f32 rounding, relative to |g|·|v|");
        }
    }
}
