//! What an inversion tells whoever listens. It draws no bars and prints nothing itself.

/// Something that happened.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A step on codes and camera was done.
    Pivot(StepReport),
    /// A step on the generator's weights was done.
    Tune(StepReport),
    /// Tuning ended early: the loss no longer falls.
    Settled {
        /// Steps done.
        step: usize,
    },
    /// Something the user should know.
    Warning(String),
}

/// One optimiser step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// Steps done.
    pub step: usize,
    /// Steps in all.
    pub total: usize,
    /// The weighted sum of all losses.
    pub loss: f64,
    /// PSNR of what was compared in this step, dB: rays of the field or the whole picture.
    pub psnr: f64,
}
