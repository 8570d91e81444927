//! Other projects' datasets, read into ours.
