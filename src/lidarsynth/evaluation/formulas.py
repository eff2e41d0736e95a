"""What the numbers of several protocols are, in words: what is squared, what is rooted, which logarithm."""

FRECHET = "|mu - mu'|^2 + tr(S + S' - 2 sqrt(S S')), covariances by n - 1, no epsilon, not rooted"
KERNEL = "unbiased squared MMD, (x.y / D + 1)^3, mean over subsets, not rooted"
JSD = "Jensen-Shannon distance: root of the divergence, natural logarithm, histograms pooled over scans"
MMD = "biased squared MMD, exp(-|p - q|^2 / (2 0.5^2)), diagonals included, not rooted, histogram per scan"
FSVD = "the Frechet distance of features averaged in 16 shells around the voxels' centroid, 48 numbers each"
OCCUPANCY = "Jensen-Shannon distance: root of the divergence, natural logarithm; 5 cm cells, each counts once per scan"
MATCHING = "mean over real scans of the least Chamfer distance to a sample, of occupied cells, squared, unit 100 m"
