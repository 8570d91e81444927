//! Vector lanes.
