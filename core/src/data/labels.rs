//! Label maps.
