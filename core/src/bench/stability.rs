//! Numbers under abuse: every part of the suite at the ends of its range, in f32 on every kernel path, against the same
//! computation in f64.
//!
//! The bound of a case is derived, not chosen. A computation is as good as f32 allows when its result is the exact one of
//! inputs moved by a few units of rounding (backward stability), so the case is computed in f64 three times more with
//! every input value moved at random by a unit of rounding (2⁻²⁴ of it, times a standard normal): with κ the largest
//! change of a quantity so found, relative in L2, its bound is [`STABILITY`]·κ + [`ROUNDING`]. κ says what the numbers'
//! own conditioning costs, e.g. 1e5 radians of sine; the first factor what sums of many roundings may add; the second
//! term, which grows as the root of a sum's length, what rounding costs results that no input moves. Gradients are held to the same rule with a κ of their own.

use candle_core::{DType, Device, Tensor, Var};
use serde::Serialize;

use crate::{
    error::{Error, Result},
    kernels::Path,
    model::file::Tensors,
    parameters::Parameters,
    rng::Stream,
};

mod field;
mod generators;
mod networks;

/// Roundings that pile up in the longest sums here (thousands of terms, five layers), in units of what moving every input
/// by one rounding does.
pub const STABILITY: f64 = 64.0;
/// What is left to f32 where moving inputs changes nothing: 32 units of rounding.
pub const ROUNDING: f64 = 32.0 * UNIT;
/// Sums up to this many terms are within [`ROUNDING`]; roundings of longer ones add up as the root of their number.
const SHORT_SUM: f64 = 1024.0;
/// Unit of rounding of f32.
const UNIT: f64 = 5.960_464_477_539_063e-8;
/// No bound is looser: beyond it a value is noise, and only finiteness is asked of it.
const LOOSEST: f64 = 2.0;
/// Root mean square below which a quantity counts as zero.
const NEGLIGIBLE: f64 = 1e-12;
/// Times that inputs are moved.
const MOVES: u64 = 3;

/// How one case went, on the path that came closest to its bound or went farthest beyond.
#[derive(Clone, Debug, Serialize)]
pub struct CaseReport {
    /// What is stressed.
    pub name: String,
    /// Whether every value and every gradient was finite, on every path.
    pub finite: bool,
    /// The largest relative error (L2) of all quantities and paths.
    pub max_rel_error_vs_f64: f64,
    /// What the error of `quantity` may be.
    pub bound: f64,
    /// Its error.
    pub error: f64,
    /// The value or gradient that came closest to its bound.
    pub quantity: String,
    /// The path it did so on.
    pub path: String,
    /// Values and gradients compared on each path.
    pub compared: usize,
    /// Finite, and every quantity within its bound.
    pub passed: bool,
}

/// All cases.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Case by case.
    pub cases: Vec<CaseReport>,
    /// How many did not pass.
    pub failed: usize,
    /// The paths each case ran on.
    pub paths: Vec<&'static str>,
}

/// Runs every case whose name contains `only` on each of `paths`; `progress` hears the names.
pub fn run(paths: &[Path], only: &str, progress: &mut dyn FnMut(&str)) -> Result<Report> {
    let mut reports = Vec::new();
    for case in cases().into_iter().filter(|case| case.name.contains(only)) {
        progress(&case.name);
        reports.push(case.run(paths)?);
    }
    let failed = reports.iter().filter(|report| !report.passed).count();
    Ok(Report { cases: reports, failed, paths: paths.iter().map(|path| path.name()).collect() })
}

/// The number of cases that `only` leaves.
pub fn count(only: &str) -> usize {
    cases().iter().filter(|case| case.name.contains(only)).count()
}

fn cases() -> Vec<Case> {
    [generators::cases(), field::cases(), networks::cases()].into_iter().flatten().collect()
}

/// The named results of one computation.
type Outputs = Vec<(&'static str, Tensor)>;

/// What a case computes, in whichever precision its inputs come.
type Computation = dyn Fn(&mut Inputs) -> Result<Outputs>;

/// Something computed from [`Inputs`] in whatever precision they have.
struct Case {
    name: String,
    /// Terms of its longest sum.
    terms: usize,
    compute: Box<Computation>,
}

impl Case {
    fn new(name: impl Into<String>, compute: impl Fn(&mut Inputs) -> Result<Outputs> + 'static) -> Self {
        Self { name: name.into(), terms: 0, compute: Box::new(compute) }
    }

    /// The same with sums of so many terms, e.g. of a gradient over all points.
    fn with_terms(self, terms: usize) -> Self {
        Self { terms, ..self }
    }

    fn run(&self, paths: &[Path]) -> Result<CaseReport> {
        let exact = self.answer(DType::F64, None)?;
        let moved =
            (0..MOVES).map(|seed| self.answer(DType::F64, Some(Stream::new(seed, &[])))).collect::<Result<Vec<_>>>()?;
        let mut report = CaseReport {
            name: self.name.clone(),
            finite: true,
            max_rel_error_vs_f64: 0.0,
            bound: ROUNDING,
            error: 0.0,
            quantity: String::new(),
            path: String::new(),
            compared: exact.len(),
            passed: true,
        };
        let mut closest = -1.0;
        for path in paths {
            let found = path.run(|| self.answer(DType::F32, None))?;
            for (index, (exact, found)) in exact.iter().zip(&found).enumerate() {
                report.finite &= found.values.iter().all(|value| value.is_finite());
                let changes = moved.iter().filter_map(|moved| moved.get(index)).map(|moved| moved.error(exact));
                let rounding = ROUNDING * (self.terms as f64 / SHORT_SUM).sqrt().max(1.0);
                let bound = (STABILITY * changes.fold(0.0, f64::max) + rounding).min(LOOSEST);
                let error = found.error(exact);
                report.max_rel_error_vs_f64 = report.max_rel_error_vs_f64.max(error);
                report.passed &= error <= bound;
                if error / bound > closest || !error.is_finite() {
                    closest = error / bound;
                    (report.bound, report.error) = (bound, error);
                    (report.quantity, report.path) = (exact.name.clone(), path.name().to_owned());
                }
            }
        }
        report.passed &= report.finite;
        Ok(report)
    }

    /// Every output, then the gradient of a fixed random weighting of all outputs with respect to every input.
    fn answer(&self, dtype: DType, jitter: Option<Stream>) -> Result<Vec<Quantity>> {
        let mut inputs = Inputs { dtype, jitter, variables: Vec::new() };
        let outputs = (self.compute)(&mut inputs)?;
        let mut quantities = Vec::new();
        let mut loss: Option<Tensor> = None;
        for (index, (name, tensor)) in outputs.iter().enumerate() {
            quantities.push(Quantity { name: (*name).to_owned(), values: values(tensor)? });
            let mut random = Stream::new(0x7570, &[index as u64]);
            let upstream = random.normal_tensor(tensor.dims(), &Device::Cpu)?.to_dtype(dtype)?;
            let term = (tensor * upstream)?.sum_all()?;
            loss = Some(match loss {
                Some(loss) => (loss + term)?,
                None => term,
            });
        }
        let loss = loss.ok_or_else(|| Error::config("stability", format!("case `{}` computes nothing", self.name)))?;
        let gradients = loss.backward()?;
        for (name, variable) in inputs.variables {
            let values = match gradients.get(&variable) {
                Some(gradient) => values(gradient)?,
                None => vec![0.0; variable.elem_count()],
            };
            quantities.push(Quantity { name: format!("gradient of {name}"), values });
        }
        Ok(quantities)
    }
}

fn values(tensor: &Tensor) -> Result<Vec<f64>> {
    Ok(tensor.detach().to_dtype(DType::F64)?.flatten_all()?.to_vec1()?)
}

/// One output or gradient.
struct Quantity {
    name: String,
    values: Vec<f64>,
}

impl Quantity {
    /// Relative in L2; infinite where a value is not finite.
    fn error(&self, exact: &Self) -> f64 {
        let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
        let difference = norm(&mut self.values.iter().zip(&exact.values).map(|(found, exact)| found - exact));
        let size = norm(&mut exact.values.iter().copied()) + NEGLIGIBLE * (exact.values.len() as f64).sqrt();
        let error = difference / size;
        if error.is_finite() { error } else { f64::INFINITY }
    }
}

/// What a case computes from: values that f32 holds exactly, in the precision asked for, perhaps moved.
struct Inputs {
    dtype: DType,
    jitter: Option<Stream>,
    variables: Vec<(String, Var)>,
}

impl Inputs {
    /// A value that the results are differentiated by.
    fn variable(&mut self, name: impl Into<String>, value: &Tensor) -> Result<Tensor> {
        let variable = Var::from_tensor(&self.constant(value)?)?;
        let tensor = variable.as_tensor().clone();
        self.variables.push((name.into(), variable));
        Ok(tensor)
    }

    /// A value that they are not.
    fn constant(&mut self, value: &Tensor) -> Result<Tensor> {
        let value = value.to_dtype(DType::F64)?;
        let Some(random) = &mut self.jitter else { return Ok(value.to_dtype(self.dtype)?) };
        let moves = random.normal_tensor(value.dims(), &Device::Cpu)?.to_dtype(DType::F64)?.affine(UNIT, 1.0)?;
        Ok((value * moves)?.to_dtype(self.dtype)?)
    }

    /// Standard normals times `deviation` that the results are differentiated by; a function of `name`.
    fn normal(&mut self, name: &'static str, shape: &[usize], deviation: f64) -> Result<Tensor> {
        let seed = name.bytes().fold(7, |seed: u64, byte| seed.wrapping_mul(31).wrapping_add(u64::from(byte)));
        let value = (Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu)? * deviation)?;
        self.variable(name, &value)
    }

    /// These weights, all of which the results are differentiated by.
    fn parameters(&mut self, weights: &Tensors) -> Result<Parameters> {
        let mut moved = std::collections::HashMap::new();
        for (name, value) in weights {
            moved.insert(name.clone(), self.constant(value)?);
        }
        Ok(Parameters::loaded(moved, self.dtype, &Device::Cpu))
    }

    /// To be called once a network has asked for its weights.
    fn differentiate(&mut self, parameters: &Parameters) {
        self.variables.extend(parameters.variables());
    }
}

/// Weights drawn from a seed, as `build` asks for them.
fn fresh<T>(build: impl Fn(&Parameters) -> Result<T>) -> Result<Tensors> {
    let parameters = Parameters::fresh(11, DType::F32, &Device::Cpu);
    build(&parameters)?;
    parameters.snapshot()
}

/// Every weight of `tensors` whose name ends in `suffix`, set to what `value` says for its place.
fn set(tensors: &mut Tensors, suffix: &str, value: impl Fn(usize) -> f32) -> Result<()> {
    let mut found = false;
    for (name, tensor) in tensors.iter_mut().filter(|(name, _)| name.ends_with(suffix)) {
        let values: Vec<f32> = (0..tensor.elem_count()).map(&value).collect();
        *tensor = Tensor::from_vec(values, tensor.shape(), &Device::Cpu)?;
        found |= !name.is_empty();
    }
    if found { Ok(()) } else { Err(Error::config("stability", format!("no weight is called `{suffix}`"))) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_least_sixty_cases_have_names_of_their_own() {
        let mut names: Vec<_> = cases().into_iter().map(|case| case.name).collect();
        names.sort();
        let all = names.len();
        names.dedup();
        assert!(all >= 60 && names.len() == all, "{all} cases, {} names", names.len());
    }

    #[test]
    fn every_case_passes_on_every_path() {
        let paths: Vec<_> = Path::available().collect();
        let report = run(&paths, "", &mut |_| ()).unwrap();
        let failed: Vec<_> = report.cases.iter().filter(|case| !case.passed).collect();
        assert!(failed.is_empty(), "{failed:#?}");
    }

    #[test]
    fn a_defect_is_found() {
        // A sum that rounds to 16 bits, a root whose slope is infinite at zero.
        let coarse = Case::new("coarse", |inputs| {
            let x = inputs.normal("x", &[50], 1.0)?;
            let rounded = if x.dtype() == DType::F32 { x.to_dtype(DType::F16)?.to_dtype(DType::F32)? } else { x };
            Ok(vec![("rounded", rounded)])
        });
        let infinite = Case::new("infinite", |inputs| {
            let x = inputs.variable("x", &Tensor::zeros(3, DType::F32, &Device::Cpu)?)?;
            Ok(vec![("root", x.sqrt()?)])
        });
        let coarse = coarse.run(&[Path::Composed]).unwrap();
        assert!(coarse.finite && !coarse.passed, "{coarse:?}");
        let infinite = infinite.run(&[Path::Composed]).unwrap();
        assert!(!infinite.finite && !infinite.passed, "{infinite:?}");
    }
}
