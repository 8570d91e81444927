//! Volume aggregation along rays.
