// Densities and lists of neighbours by `density_of_tile`, against all pairs in float64.

#include <algorithm>
#include <numeric>

#include "cuda_on_cpu.h"

#include "native.h"  // the native code, with plain copies instead of `cp.async`: test_tiles.py writes it

struct Domain {
    wp::vec_t<2, int> cell_shape;
    wp::vec_t<2, float> box, inverse_box;
    float inverse_squared_eps;
};

enum Bad { NONE, NUMBERLESS, INFINITE, DISTANT, OUTERMOST };

// A cell's number along one side, as `cell_of` of npa_envs/kernels/domain.py gives it.
int cell_along(double position, double side, double size, int count, bool periodic)
{
    if (!(std::abs(position) < 1e18)) return 0;
    if (!periodic) return (long long)std::floor(position / size) & (count - 1);
    const double part = position / side - std::floor(position / side);
    return std::min(int(part * count), count - 1);
}

template <int CAPACITY, bool PERIODIC>
int check(int count, int worlds, float half_x, float half_y, float spread, Bad kind, unsigned seed)
{
    const double eps = 0.2, size = eps / 2 * (1 + std::ldexp(1.0, -20));
    int nx = 8, ny;
    while (nx * nx < count) nx *= 2;
    ny = nx;
    if (PERIODIC) nx = int(2 * half_x / size), ny = int(2 * half_y / size);
    const double sides[] = {2.0 * half_x, 2.0 * half_y};
    const Domain domain = {{nx, ny}, {float(sides[0]), float(sides[1])},
        {float(1 / sides[0]), float(1 / sides[1])}, float(1 / (eps * eps))};
    std::srand(seed);
    const auto draw = [&](float half) {
        return float((std::rand() / double(RAND_MAX) * 2 - 1) * half * spread);
    };
    const int cells = nx * ny, total = count * worlds;
    std::vector<float2> positions;
    std::vector<int> cell, starts(worlds * cells + 1), rows(total, -1);
    for (int world = 0; world < worlds; ++world) {
        std::vector<std::pair<int, float2>> sorted;
        for (int i = 0; i < count; ++i) {
            float2 p = {draw(half_x), draw(half_y)};
            if (i % 23 == 7) {
                if (kind == NUMBERLESS) p.x = NAN;
                if (kind == INFINITE) p.y = -INFINITY;
                if (kind == DISTANT) p.x += 1000 * float(sides[0]);
                // Any finite position is legal, and two at one place are neighbours.
                if (kind == OUTERMOST) p.x = p.y = i % 2 ? 1e30f : -1e30f;
            }
            const int x = cell_along(p.x, sides[0], size, nx, PERIODIC);
            const int y = cell_along(p.y, sides[1], size, ny, PERIODIC);
            sorted.push_back({y * nx + x, p});
        }
        std::stable_sort(sorted.begin(), sorted.end(),
            [](const auto& a, const auto& b) { return a.first < b.first; });
        for (const auto& [number, p] : sorted) {
            positions.push_back(p);
            cell.push_back(world * cells + number);
            ++starts[cell.back() + 1];
        }
    }
    std::partial_sum(starts.begin(), starts.end(), starts.begin());
    int row_count = 0;
    for (int& row : rows) {
        if (std::rand() & 64) row = row_count++;
    }
    std::vector<uint4> lists(row_count * CAPACITY / 8 + 1);
    std::vector<int> lengths(row_count + 1, -1);
    std::vector<float> sums(total, NAN);
    short* steps = reinterpret_cast<short*>(lists.data());
    auto* vectors = reinterpret_cast<wp::vec_t<2, float>*>(positions.data());
    for (int world = 0; world < worlds; ++world) {
        for (int first = world * count; first < (world + 1) * count; first += 8) {
            block::run(32, [&] {
                const int own = first + threadIdx.x / 4;
                const bool inside = own < (world + 1) * count;
                const int k = inside ? own : first;
                const float sum = npa::density_of_tile<CAPACITY, PERIODIC>(domain,
                    {starts.data()}, {cell.data()}, {vectors}, world * cells, first, k, inside,
                    inside ? rows[k] : -1, {steps}, {lengths.data()});
                if (inside && threadIdx.x % 4 == 0) sums[k] = sum;
            });
        }
    }
    int wrong = 0;
    for (int k = 0; k < total; ++k) {
        const float2 own = positions[k];
        if (!std::isfinite(own.x) || !std::isfinite(own.y)) continue;
        double sum = 0;
        std::vector<int> near, surely;
        for (int j = k / count * count; j < (k / count + 1) * count; ++j) {
            double x = double(positions[j].x) - own.x, y = double(positions[j].y) - own.y;
            if (PERIODIC) {
                x -= sides[0] * std::rint(x / sides[0]);
                y -= sides[1] * std::rint(y / sides[1]);
            }
            const double falloff = 1 - (x * x + y * y) / (eps * eps);
            if (falloff > 0) sum += falloff * falloff * falloff;
            // Of distant particles float32 knows the place to 1e-4 alone.
            if (falloff > -1e-2) near.push_back(j - k);
            if (falloff > 1e-2) surely.push_back(j - k);
        }
        bool right = std::abs(sums[k] - sum) < (kind == DISTANT ? 1e-2 : 2e-5) * sum;
        if (rows[k] >= 0) {
            const int length = lengths[rows[k]];
            if (length > CAPACITY) {
                right = right && int(near.size()) > CAPACITY;
            } else {
                const short* list = steps + rows[k] * CAPACITY;
                std::vector<int> listed(list, list + length);
                std::sort(listed.begin(), listed.end());
                right = right && std::includes(near.begin(), near.end(), listed.begin(), listed.end())
                    && std::includes(listed.begin(), listed.end(), surely.begin(), surely.end());
            }
        }
        wrong += !right;
    }
    if (wrong) {
        std::printf("capacity %d, periodic %d, %d particles, half sides %g %g, spread %g, kind %d: "
            "%d of %d are wrong\n", CAPACITY, PERIODIC, count, half_x, half_y, spread, kind, wrong, total);
    }
    return wrong;
}

int main()
{
    int wrong = 0, worlds = 0;
    for (int count : {1, 9, 61, 203}) {
        for (Bad kind : {NONE, NUMBERLESS, INFINITE, DISTANT, OUTERMOST}) {
            wrong += check<128, false>(count, 2, 0.7f, 0.7f, 1.0f, kind, count);
            wrong += check<64, false>(count, 1, 6.0f, 0.05f, 1.0f, kind, count);
            wrong += check<64, false>(count, 1, 0.1f, 0.1f, 1.0f, kind, count);
            worlds += 4;
            if (kind == OUTERMOST) continue;  // nobody knows where in a box they lie
            // Boxes of 7 cells and more along a side; particles in the box, and boxes away.
            for (float half : {0.355f, 0.405f, 0.46f, 0.7f, 2.0f}) {
                for (float spread : {1.0f, 5.0f}) {
                    wrong += check<256, true>(count, 2, half, 0.36f, spread, kind, count);
                    wrong += check<64, true>(count, 2, 0.36f, half, spread, kind, count);
                }
            }
            worlds += 40;
        }
    }
    std::printf("%d worlds, %d particles wrong\n", worlds, wrong);
    return wrong != 0;
}
