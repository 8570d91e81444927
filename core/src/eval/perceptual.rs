//! LPIPS.
