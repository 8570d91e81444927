//! Reading and writing pictures without trusting them.
