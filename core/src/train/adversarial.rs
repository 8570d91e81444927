//! Adversarial losses and their exact gradient penalties.
