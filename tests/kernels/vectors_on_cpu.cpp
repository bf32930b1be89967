// The kernels of equivariant rules; test_emulated.py writes their sizes, and compares the results.

#include "cuda_on_cpu.h"

#include "equivariance.cuh"
#include "sums.h"

#include "sizes.h"

// An array of so many rows and columns, which is read from a file or written to one.
struct Table {
    std::vector<float> values;
    wp::array_t<float> array;

    Table(int rows, int columns)
        : values((size_t)rows * columns), array{values.data(), {rows, columns}} {}

    void read(std::FILE* file)
    {
        if (std::fread(values.data(), 4, values.size(), file) != values.size()) std::abort();
    }

    void write(std::FILE* file) const { std::fwrite(values.data(), 4, values.size(), file); }
};

int main()
{
    std::FILE* file = std::fopen("in", "rb");
    Table rows(COUNT, WIDTH), mixing(1, WEIGHTS), mixed(1, VECTORS), mixed_bar(1, VECTORS);
    Table inputs(COUNT, IN_WIDTH), inputs_bar(COUNT, IN_WIDTH), rows_bar(COUNT, WIDTH);
    // Fewer blocks than have all rows, so that warps come back for more.
    Table sums(1, WEIGHTS), mixing_bar(1, WEIGHTS), output(COUNT, OUT_WIDTH), signs(1, GATES);
    Table update(COUNT, UP_WIDTH), update_bar(COUNT, UP_WIDTH), output_bar(COUNT, OUT_WIDTH);
    Table pulled(1, VECTORS);
    for (Table* table :
         {&rows, &mixing, &mixed_bar, &inputs_bar, &output, &signs, &update_bar}) {
        table->read(file);
    }
    std::fclose(file);
    block::launch(READ_BLOCKS, READ_WARPS * 32, [&] {
        npa::read_vectors<FORM, READ_WARPS, ROWS>(
            rows.array, mixing.array, mixed.array, inputs.array);
    });
    block::launch(1, PULL_WARPS * 32, [&] {
        npa::pull_back_vectors<FORM, PULL_WARPS, ROWS>(
            rows.array, mixing.array, mixed.array, mixed_bar.array, inputs_bar.array,
            rows_bar.array, sums.array);
    });
    block::launch((WEIGHTS + 31) / 32, MIXING_SUM_WARPS * 32, [&] {
        npa::add_partial_sums<MIXING_SUM_WARPS>(sums.array, mixing_bar.array);
    });
    block::launch(STEER_BLOCKS, STEER_WARPS * 32, [&] {
        npa::steer_by_gates<STEERING, STEER_WARPS, STEERED_ROWS>(
            output.array, mixed.array, signs.array, update.array);
    });
    block::launch(STEER_BLOCKS, STEER_WARPS * 32, [&] {
        npa::pull_back_gates<STEERING, STEER_WARPS, STEERED_ROWS>(
            output.array, mixed.array, signs.array, update_bar.array, output_bar.array,
            pulled.array);
    });
    file = std::fopen("out", "wb");
    for (const Table* table :
         {&mixed, &inputs, &rows_bar, &mixing_bar, &update, &output_bar, &pulled}) {
        table->write(file);
    }
    std::fclose(file);
}
