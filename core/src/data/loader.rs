//! Batches, streamed and prefetched.
