use candle_core::*;
use cnerf_core::kernels::conv::*;
unsafe extern "C" { fn mallopt(a: i32, b: i32) -> i32; fn clock_gettime(c: i32, t: *mut [i64; 2]) -> i32; }
fn cpu() -> f64 { unsafe { let mut t = [0i64; 2]; clock_gettime(2, &mut t); t[0] as f64 + t[1] as f64 * 1e-9 } }
fn best(mut f: impl FnMut()) -> f64 { f(); let mut b = f64::MAX; let start = cpu(); let mut n = 0; while n < 3 || (cpu() - start < 0.25 && n < 60) { let t = cpu(); f(); b = b.min(cpu() - t); n += 1 } b }
fn main() {
    unsafe { mallopt(-3, 1 << 30); mallopt(-1, 1 << 30); }

    let candle = std::env::args().any(|a| a == "candle");
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global().unwrap();
    let d = Device::Cpu; println!("peak {:.1}", peak());
    println!("{:34} {:>8} {:>8} {:>8}   {:>8} {:>8}", "shape (GFLOP/s per core)", "forward", "dx", "dw", "candle f", "candle b");
    let only = std::env::var("ONLY").ok(); for (name, b, c, o, s, k, st, p) in [
        ("256ch@64", 1usize, 256usize, 256usize, 64usize, 3usize, 1usize, 1usize), ("64ch@128", 1, 64, 64, 128, 3, 1, 1), ("32ch@256", 1, 32, 32, 256, 3, 1, 1),
        ("44ch@48 b8", 8, 44, 44, 48, 3, 1, 1), ("28ch@96 b8", 8, 28, 28, 96, 3, 1, 1),
        ("64ch@128 stride 2", 1, 64, 64, 128, 3, 2, 1), ("4x4 s2 64ch@64 b8", 8, 64, 64, 64, 4, 2, 1), ("1x1 64>64@64 b8", 8, 64, 64, 64, 1, 1, 0), ("3x3 512ch@8 b8", 8, 512, 512, 8, 3, 1, 1), ("3x3 512ch@4 b8", 8, 512, 512, 4, 3, 1, 1),
        ("alex1 3>64 11x11s4@96", 1, 3, 64, 96, 11, 4, 2), ("alex2 64>192 5x5@11", 1, 64, 192, 11, 5, 1, 2), ("alex3 192>384@5", 1, 192, 384, 5, 3, 1, 1),
        ("vgg 3>64@96", 1, 3, 64, 96, 3, 1, 1), ("vgg 64@96", 1, 64, 64, 96, 3, 1, 1), ("vgg 128@48", 1, 128, 128, 48, 3, 1, 1), ("vgg 256@24", 1, 256, 256, 24, 3, 1, 1), ("vgg 512@12", 1, 512, 512, 12, 3, 1, 1), ("vgg 512@6", 1, 512, 512, 6, 3, 1, 1), ("rgb 64>3@128", 1, 64, 3, 128, 1, 1, 0),
    ] {
        if only.as_ref().is_some_and(|o| !o.split(",").any(|o| name.contains(o))) { continue }
        let x = Tensor::randn(0f32, 1., (b, c, s, s), &d).unwrap(); let w = Tensor::randn(0f32, 1., (o, c, k, k), &d).unwrap();
        let y = conv2d(&x, &w, None, st, p).unwrap(); let g = Tensor::randn(0f32, 1., y.shape(), &d).unwrap();
        let fl = 2.0 * (y.elem_count() * c * k * k) as f64 / 1e9;
        let f = best(|| { conv2d(&x, &w, None, st, p).unwrap(); });
        let dx = best(|| { conv2d_input_gradient(&g, &w, (s, s), st, p).unwrap(); });
        let dw = best(|| { conv2d_weight_gradient(&x, &g, (k, k), st, p).unwrap(); });
        let (mut cf, mut cb) = (f64::NAN, f64::NAN);
        if candle { cf = best(|| { x.conv2d(&w, p, st, 1, 1).unwrap(); });
            let (xv, wv) = (Var::from_tensor(&x).unwrap(), Var::from_tensor(&w).unwrap());
            let both = best(|| { (xv.conv2d(&wv, p, st, 1, 1).unwrap() * &g).unwrap().sum_all().unwrap().backward().unwrap(); }); cb = both - cf; }
        println!("{name:34} {:8.1} {:8.1} {:8.1}   {:8.1} {:8.1}   both gradients {:.1}", fl / f, fl / dx, fl / dw, fl / cf, 2. * fl / cb, 2. * fl / (dx + dw));
    }
}

#[target_feature(enable = "avx512f")]
fn fma(n: usize) -> f32 { use std::arch::x86_64::*; let mut a = [_mm512_set1_ps(0.5); 16]; let b = std::hint::black_box(_mm512_set1_ps(0.999)); let c = std::hint::black_box(_mm512_set1_ps(1e-3)); for _ in 0..n { for a in a.iter_mut() { *a = _mm512_fmadd_ps(*a, b, c) } } a.iter().map(|a| _mm512_reduce_add_ps(*a)).sum() }
fn peak() -> f64 { let n = 1_000_000; let t = best(|| { std::hint::black_box(unsafe { fma(n) }); }); (n * 16 * 32) as f64 / t / 1e9 }
