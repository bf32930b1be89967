// Means of worlds that a block sorts.

namespace npa {

// Mean of a world's positions, summed in the order of kernels/portable/world_mean.py: a warp sums
// CHUNK values, then the chunks' sums. All threads of the block call it and get the mean.
template <int CAPACITY, int CHUNK>
__device__ inline wp::vec_t<2, float> mean_of_world(
    const wp::array_t<wp::vec_t<2, float>>& positions, int first, int count)
{
    __shared__ double sums[2 * CAPACITY / CHUNK];
    const int lane = threadIdx.x & 31, chunks = (count + CHUNK - 1) / CHUNK;
    for (int task = threadIdx.x / 32; task < 2 * chunks; task += blockDim.x / 32) {
        const int chunk = task / 2, end = min((chunk + 1) * CHUNK, count);
        double total = 0.0;
        for (int i = chunk * CHUNK + lane; i < end; i += 32) {
            total += (double)positions.data[first + i][task & 1];
        }
        total = lane_sum<double, 32, true, 1>(total);
        if (lane == 0) sums[task] = total;
    }
    __syncthreads();
    double totals[2] = {0.0, 0.0};
    for (int chunk = lane; chunk < chunks; chunk += 32) {
        totals[0] += sums[2 * chunk];
        totals[1] += sums[2 * chunk + 1];
    }
    for (double& total : totals) total = lane_sum<double, 32, true, 1>(total);
    return wp::vec_t<2, float>((float)(totals[0] / count), (float)(totals[1] / count));
}

}  // namespace npa
