//! Plans against the exhaustive path: bit-equality without a budget, errors within the reported bound with one, on
//! every form of the field.

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    camera::{self, Camera, pixel_centres},
    codes::{Aspect, blend},
    config::{Background, DensityKind, FieldConfig, Fusion, InitialDistance, Residual, SdfHead},
    kernels::{self, Outputs, Path},
    model::field::{Field, PortraitField},
    parameters::Parameters,
    region::{Region, RegionSet},
    render::{
        Frame, RayBundle, RenderSettings, Sampling,
        plan::{Method, Planned, ROUNDING, Sequence, Session, render},
        render_frame, render_rays,
    },
    rng::Stream,
};

fn config(form: FieldConfig) -> FieldConfig {
    FieldConfig { style_dim: 6, width: 20, ..form }
}

/// Every combination that changes how a point's values are put together.
fn forms() -> Vec<FieldConfig> {
    let ours = FieldConfig { alpha_initial: 0.004, ..config(FieldConfig::ours()) };
    let paper = FieldConfig { alpha_initial: 0.02, ..config(FieldConfig::paper()) };
    vec![
        ours.clone(),
        paper.clone(),
        FieldConfig { fusion: Fusion::Raw, ..ours.clone() },
        FieldConfig { residual: Residual::Sum, background: Background::Field, ..ours.clone() },
        FieldConfig { sdf_head: SdfHead::Texture, ..paper.clone() },
        FieldConfig { initial_distance: InitialDistance::Network, ..paper.clone() },
        FieldConfig { density: DensityKind::Sdf, ..paper.clone() },
        FieldConfig { density: DensityKind::Density, ..ours },
    ]
}

fn codes(batch: usize, seed: u64) -> Tensor {
    Stream::new(seed, &[]).normal_tensor(&[batch, 9, 2, 6], &Device::Cpu).unwrap()
}

/// Random weights, masks sharpened so that regions do have borders.
fn field(form: &FieldConfig, codes: &Tensor, seed: u64) -> PortraitField {
    let parameters = Parameters::fresh(seed, DType::F32, &Device::Cpu);
    let field = Field::new(form, &parameters).unwrap();
    for (name, variable) in parameters.variables() {
        if name.contains("mask") || name.contains("colour") {
            variable.set(&(variable.as_tensor() * 12.0).unwrap()).unwrap();
        }
    }
    field.portraits(codes).unwrap()
}

fn settings(form: &FieldConfig, budget: f64) -> RenderSettings {
    let sampling = match form.background {
        Background::Field => Sampling::closed(9),
        Background::FarPlane => Sampling::behind_the_surface(9),
    };
    RenderSettings { resolution: 30, sampling, features: true, normals: true, budget, ..RenderSettings::default() }
}

fn cameras(cameras: &[Camera]) -> Tensor {
    Camera::parameter_tensor(cameras, &Device::Cpu).unwrap()
}

/// All rays at once through `render_rays`, which knows no plans.
fn without_plans(field: &PortraitField, cameras: &Tensor, settings: &RenderSettings) -> Frame {
    let (batch, side) = (cameras.dim(0).unwrap(), settings.resolution);
    let pixels = pixel_centres(side, &Device::Cpu).unwrap();
    let rays = camera::cast(cameras, &pixels, side, settings.field_of_view_rad).unwrap();
    let rays = RayBundle::new(rays).unwrap();
    let depths = settings.sampling.regular(DType::F32, &Device::Cpu).unwrap();
    let outputs = Outputs { gradient: settings.normals, colour: true, activations: settings.features };
    let output = render_rays(field, &rays, &depths, &settings.sampling, outputs, settings.regions).unwrap();
    let picture = |rows: &Tensor| rows.reshape((batch, (), side, side)).unwrap();
    Frame {
        colour: picture(&output.colour),
        features: output.features.as_ref().map(picture),
        masks: picture(&output.masks),
        depth: picture(&output.depth),
        normal: output.normal.as_ref().map(picture),
        point: picture(&output.point),
        opacity: picture(&output.weights.remaining.affine(-1.0, 1.0).unwrap()),
    }
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn difference(left: &Tensor, right: &Tensor) -> f64 {
    assert_eq!(left.dims(), right.dims());
    let pairs = values(left).into_iter().zip(values(right));
    pairs.map(|(left, right)| f64::from((left - right).abs())).fold(0.0, f64::max)
}

/// Colours are in [-1, 1], bounds in [0, 1].
fn colour_error(left: &Frame, right: &Frame) -> f64 {
    difference(&left.colour, &right.colour) / 2.0
}

fn assert_same_bits(left: &Frame, right: &Frame, name: &str) {
    let pictures = |frame: &Frame| {
        let mut all = vec![frame.colour.clone(), frame.masks.clone(), frame.depth.clone(), frame.opacity.clone()];
        all.extend([Some(frame.point.clone()), frame.features.clone(), frame.normal.clone()].into_iter().flatten());
        all
    };
    for (index, (left, right)) in pictures(left).iter().zip(pictures(right)).enumerate() {
        let same = values(left).iter().zip(values(&right)).all(|(left, right)| left.to_bits() == right.to_bits());
        assert!(same, "{name}, picture {index}");
    }
}

#[test]
fn a_budget_of_zero_is_the_exhaustive_path() {
    for (seed, form) in forms().iter().enumerate() {
        let field = field(form, &codes(2, 1), seed as u64);
        let cameras = cameras(&[Camera::at(0.3, 0.1), Camera::at(-0.5, 0.0)]);
        let settings = settings(form, 0.0);
        let planned = render(&field, &cameras, &settings).unwrap();
        assert_eq!((planned.report.method, planned.report.bound), (Method::Exhaustive, 0.0));
        assert_eq!(planned.report.pairs_skipped, 0);
        let rendered = [
            render_frame(&field, &cameras, &settings).unwrap(),
            Session::new(&cameras, &settings).unwrap().render(&field).unwrap().frame,
            render(&field, &cameras, &RenderSettings { budget: ROUNDING, ..settings.clone() }).unwrap().frame,
        ];
        rendered.iter().for_each(|frame| assert_same_bits(frame, &planned.frame, &format!("{form:?}")));

        // The kernels sum along rays as they go, tensors afterwards and in another order.
        let by_tensors = without_plans(&field, &cameras, &settings);
        assert_differs_by_rounding(&planned.frame, &by_tensors, &format!("{form:?}"));
        Path::Composed.run(|| {
            let planned = render(&field, &cameras, &settings).unwrap().frame;
            assert_same_bits(&planned, &without_plans(&field, &cameras, &settings), "candle's operations");
        });
    }
}

/// Colours and opacity within what plans set aside for rounding, thrice, as logits here are large; masks and features
/// within as many units of their range; depths and points near 1; normals divide by the opacity's last digits.
fn assert_differs_by_rounding(left: &Frame, right: &Frame, name: &str) {
    let range = |tensor: &Tensor| values(tensor).into_iter().fold(1f64, |most, value| most.max(f64::from(value.abs())));
    let close = |left: &Tensor, right: &Tensor, picture: &str, bound: f64| {
        let found = difference(left, right) / range(right);
        assert!(found <= bound, "{name}, {picture}: {found}");
    };
    close(&left.colour, &right.colour, "colour", 3.0 * ROUNDING);
    close(&left.opacity, &right.opacity, "opacity", 3.0 * ROUNDING);
    close(&left.masks, &right.masks, "masks", 3.0 * ROUNDING);
    close(left.features.as_ref().unwrap(), right.features.as_ref().unwrap(), "features", 3.0 * ROUNDING);
    close(&left.depth, &right.depth, "depth", 2e-6);
    close(&left.point, &right.point, "point", 2e-6);
    close(left.normal.as_ref().unwrap(), right.normal.as_ref().unwrap(), "normal", 2e-3);
}

#[test]
fn errors_stay_within_the_reported_bound_and_the_bound_within_the_budget() {
    for (seed, form) in forms().iter().enumerate() {
        let field = field(form, &codes(2, 1), seed as u64);
        let cameras = cameras(&[Camera::at(0.3, 0.1), Camera::at(-0.5, 0.0)]);
        let exact = render(&field, &cameras, &settings(form, 0.0)).unwrap().frame;
        let mut skipped = 0;
        for budget in [1e-4, 5e-4, 2e-3, 1e-2, 5e-2] {
            let Planned { frame, report } = render(&field, &cameras, &settings(form, budget)).unwrap();
            let name = format!("{form:?} at {budget}: {report:?}");
            assert_eq!(report.method, Method::Planned, "{name}");
            assert!(report.bound <= budget && report.mean_bound <= report.bound, "{name}");
            let error = colour_error(&frame, &exact);
            assert!(error <= report.bound, "{error} {name}");
            assert!(difference(&frame.opacity, &exact.opacity) <= report.bound, "{name}");
            if matches!(form.fusion, Fusion::Softmax { .. }) {
                assert!(difference(&frame.masks, &exact.masks) <= report.bound, "{name}");
            }
            assert!(report.pairs_skipped >= skipped, "a larger budget skips no less: {name}");
            skipped = report.pairs_skipped;
            let features = difference(frame.features.as_ref().unwrap(), exact.features.as_ref().unwrap());
            // Features are linear in the activations: 20 units of 9 regions whose weights (identity at first) sum to
            // about 1 a row, ranges of 2.
            assert!(features <= 40.0 * report.bound, "{features} {name}");
        }
        assert!(skipped > 0, "{form:?}");
    }
}

/// Space is proven empty by some of the regions alone, whether a session has known the others or not.
#[test]
fn empty_space_costs_few_shape_branches() {
    // Residuals as small as trained ones, so that the sphere's surroundings are empty.
    let form = FieldConfig { residual_scale: 0.02, alpha_initial: 0.001, ..forms().remove(0) };
    let (field, camera) = (field(&form, &codes(1, 1), 4), cameras(&[Camera::at(0.3, 0.1)]));
    let exact = render(&field, &camera, &settings(&form, 0.0)).unwrap().frame;
    let Planned { frame, report } = render(&field, &camera, &settings(&form, 2e-3)).unwrap();
    assert!(colour_error(&frame, &exact) <= report.bound && report.bound <= 2e-3, "{report:?}");
    assert!(report.samples_evaluated < report.samples / 2, "{report:?}");
    assert!(report.shape_pairs_evaluated < 4 * report.samples, "{report:?}");
}

#[test]
fn a_tiny_budget_differs_by_rounding_alone() {
    for (seed, form) in forms().iter().enumerate() {
        let field = field(form, &codes(1, 1), seed as u64);
        let cameras = cameras(&[Camera::at(0.2, -0.1)]);
        let exact = render(&field, &cameras, &settings(form, 0.0)).unwrap().frame;
        let Planned { frame, report } = render(&field, &cameras, &settings(form, 3.0 * ROUNDING)).unwrap();
        assert_eq!(report.method, Method::Planned);
        assert!(colour_error(&frame, &exact) <= report.bound, "{form:?} {}", colour_error(&frame, &exact));
        assert!(difference(&frame.depth, &exact.depth) < 2e-6, "{form:?}");
        assert!(difference(&frame.point, &exact.point) < 2e-6, "{form:?}");
        let normal = difference(frame.normal.as_ref().unwrap(), exact.normal.as_ref().unwrap());
        assert!(normal < 2e-3, "{form:?} {normal}");
    }
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let form = &forms()[0];
    let field = field(form, &codes(1, 1), 3);
    let cameras = cameras(&[Camera::at(0.2, -0.1)]);
    for budget in [0.0, 2e-3] {
        let settings = RenderSettings { resolution: 50, ..settings(form, budget) };
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| render(&field, &cameras, &settings).unwrap())
        };
        let one = with(1);
        for threads in [2, 5] {
            let many = with(threads);
            assert_same_bits(&one.frame, &many.frame, &format!("{threads} threads"));
            assert_eq!(one.report, many.report);
        }
    }
}

#[test]
fn degenerate_views_stay_finite_and_bounded() {
    let half = std::f64::consts::FRAC_PI_2;
    let wide = 2.0;
    let views = [
        (Camera::at(0.0, half), wide),                           // over the pole
        (Camera::at(3.0, -half), 0.2),                           // under the chin
        (Camera { shift_x: 40.0, ..Camera::at(0.0, 0.0) }, 0.2), // rays that hit nothing
        (Camera { zoom: 1e4, ..Camera::at(0.0, 0.0) }, 0.2),     // one point, everywhere
    ];
    for form in forms().iter().take(4) {
        let field = field(form, &codes(1, 1), 2);
        for (camera, field_of_view_rad) in views {
            for near in [0.88, 0.995] {
                // From 0.995 on, cameras are as good as inside the head.
                let sampling = Sampling { near, ..settings(form, 0.0).sampling };
                let exact = RenderSettings { field_of_view_rad, sampling, ..settings(form, 0.0) };
                let budgeted = RenderSettings { budget: 2e-3, ..exact.clone() };
                let exact = render(&field, &cameras(&[camera]), &exact).unwrap().frame;
                let Planned { frame, report } = render(&field, &cameras(&[camera]), &budgeted).unwrap();
                assert!(values(&frame.colour).iter().all(|value| value.is_finite()), "{form:?} {camera:?}");
                assert!(colour_error(&frame, &exact) <= report.bound, "{form:?} {camera:?} {report:?}");
                assert!(report.bound <= 2e-3);
            }
        }
    }
}

#[test]
fn hidden_regions_and_perturbed_depths_keep_the_bound() {
    for form in forms().iter().take(4) {
        let field = field(form, &codes(1, 1), 2);
        let cameras = cameras(&[Camera::at(0.2, 0.1)]);
        for regions in [RegionSet::from(Region::Hair).with(Region::Background), RegionSet::FOREGROUND, RegionSet::EMPTY]
        {
            let exact = RenderSettings { regions, perturb: Some(7), ..settings(form, 0.0) };
            let budgeted = RenderSettings { budget: 1e-3, ..exact.clone() };
            let exact = render(&field, &cameras, &exact).unwrap().frame;
            let Planned { frame, report } = render(&field, &cameras, &budgeted).unwrap();
            assert!(colour_error(&frame, &exact) <= report.bound, "{form:?} {regions} {report:?}");
            for region in Region::ALL.iter().filter(|region| !regions.contains(**region)) {
                let row = frame.masks.narrow(1, region.index(), 1).unwrap();
                assert_eq!(difference(&row, &row.zeros_like().unwrap()), 0.0);
            }
        }
    }
}

#[test]
fn sessions_give_the_bits_of_whole_frames_and_evaluate_only_what_an_edit_changed() {
    for form in forms() {
        let parameters = Parameters::fresh(2, DType::F32, &Device::Cpu);
        let model = Field::new(&form, &parameters).unwrap();
        let cameras = cameras(&[Camera::at(0.2, 0.1)]);
        let settings = settings(&form, 2e-3);
        let mut session = Session::new(&cameras, &settings).unwrap();
        let (mut current, other) = (codes(1, 1), codes(1, 2));
        let whole = session.render(&model.portraits(&current).unwrap()).unwrap().report;
        assert!(session.memory() > 0);
        let again = session.render(&model.portraits(&current).unwrap()).unwrap().report;
        assert_eq!(again.shape_pairs_evaluated, 0, "{form:?}");
        for (region, aspect) in [
            (Region::Hair, Aspect::Texture),
            (Region::Face, Aspect::Shape),
            (Region::Mouth, Aspect::Both),
            (Region::Background, Aspect::Both),
        ] {
            current = blend(&current, &other, RegionSet::from(region), aspect, 1.0).unwrap();
            let field = model.portraits(&current).unwrap();
            let edited = session.render(&field).unwrap();
            let fresh = render(&field, &cameras, &settings).unwrap();
            assert_same_bits(&edited.frame, &fresh.frame, &format!("{form:?} {region} {aspect:?}"));
            assert_eq!(edited.report.bound, fresh.report.bound);
            if aspect == Aspect::Texture && form.sdf_head == SdfHead::Shape {
                assert_eq!(edited.report.shape_pairs_evaluated, 0, "{form:?}");
                assert!(edited.report.pairs_evaluated < whole.pairs_evaluated, "{form:?}");
            }
            if aspect == Aspect::Shape && form.sdf_head == SdfHead::Shape {
                assert!(edited.report.shape_pairs_evaluated * 3 < whole.shape_pairs_evaluated, "{form:?}");
            }
        }
    }
}

#[test]
fn budgets_that_are_no_budgets_are_refused() {
    let form = &forms()[0];
    let field = field(form, &codes(1, 1), 2);
    for budget in [-1.0, f64::NAN, f64::INFINITY] {
        let message = render(&field, &cameras(&[Camera::default()]), &settings(form, budget)).unwrap_err().to_string();
        assert!(message.contains("budget"), "{message}");
    }
}

#[test]
fn sequences_stay_within_their_estimate_of_the_exhaustive_path() {
    for (seed, form) in forms().iter().enumerate() {
        let field = field(form, &codes(1, 1), seed as u64);
        let views: Vec<Camera> = (0..4).map(|view| Camera::at(0.3 * f64::from(view) - 0.5, 0.1)).collect();
        let views = cameras(&views);
        let settings = settings(form, 2e-3);
        let sequence = Sequence::new(&field, &views, &settings).unwrap();
        for view in 0..4 {
            let camera = views.narrow(0, view, 1).unwrap();
            let exact = render(&field, &camera, &RenderSettings { budget: 0.0, ..settings.clone() }).unwrap().frame;
            let planned = render(&field, &camera, &settings).unwrap().report;
            let Planned { frame, report } = sequence.render(&field, &camera).unwrap();
            let name = format!("{form:?} view {view}: {report:?}");
            assert!(report.bound <= 2e-3, "{name}");
            assert!(colour_error(&frame, &exact) <= report.bound, "{} {name}", colour_error(&frame, &exact));
            assert!(difference(&frame.opacity, &exact.opacity) <= 2e-3, "{name}");
            if report.method == Method::Shared {
                assert!(sequence.grid_pairs() > 0 && sequence.memory() > 0);
                // A density that is nowhere small leaves nothing to interpolate.
                let less = report.shape_pairs_evaluated < planned.shape_pairs_evaluated;
                assert!(less || form.density == DensityKind::Density, "{name} {planned:?}");
            } else {
                assert!(form.mask_view_input, "{name}");
                assert_eq!(report, planned);
            }
        }
    }
}

#[test]
fn sequences_do_not_depend_on_the_number_of_threads() {
    let form = &forms()[0];
    let field = field(form, &codes(1, 1), 3);
    let views = cameras(&[Camera::at(0.2, -0.1), Camera::at(0.0, 0.0)]);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let sequence = Sequence::new(&field, &views, &settings(form, 2e-3)).unwrap();
            sequence.render(&field, &views).unwrap()
        })
    };
    let (one, many) = (with(1), with(3));
    assert_same_bits(&one.frame, &many.frame, "threads");
    assert_eq!(one.report, many.report);
}

/// The tests of bounds and bits again on every kernel this processor has: the choice is made once a process.
#[test]
fn every_kernel_keeps_the_bound() {
    for kernel in kernels::kernels().filter(|kernel| kernel.available()) {
        let output = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["a_budget_of_zero", "errors_stay_within", "sessions_give", "sequences_stay"])
            .env(kernels::KERNEL_VARIABLE, kernel.name())
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && said.contains("4 passed"), "{}: {said}", kernel.name());
    }
}
