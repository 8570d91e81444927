//! The compositional field: nine local generators over one signed distance.
