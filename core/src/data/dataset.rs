//! Datasets: a folder or a stored zip of pictures, label maps and cameras.
