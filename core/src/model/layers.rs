//! StyleGAN2's building blocks.
