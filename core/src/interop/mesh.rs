//! Surfaces as GLB, PLY and OBJ.
