//! Distances between pictures and between label maps.
