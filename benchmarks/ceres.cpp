// The plain bundle adjustment of benchmarks/ba.py by Ceres: rotation and translation a view, points, priors on cameras.
// Analytic derivatives, points eliminated first, one thread. Reads a block written by benchmarks/ceres.py, and prints
// for each way to solve it: CPU seconds (problem and solve), sum of squares, iterations, peak memory [MB].

#include <sys/resource.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <string>
#include <vector>

#include "ceres/ceres.h"

namespace {

constexpr double kA = 6378137.0, kF = 1.0 / 298.257223563, kE2 = kF * (2.0 - kF), kDegree = M_PI / 180.0;

struct View {
  double center[3], reach, offset[5], scale[5];  // reach: metres a radian; lon, lat [deg], alt, col, row
  double coeffs[4][20];                          // RPC00B
  double sigma[6];
};

struct Seen {
  int32_t view, point;
  double col, row, sigma;
};

void Monomials(const double* g, double m[20], double d[20][3]) {
  const double x = g[0], y = g[1], z = g[2];  // lon, lat, alt
  const double value[20] = {1,         x,         y,         z,         x * y,     x * z,     y * z,
                            x * x,     y * y,     z * z,     x * y * z, x * x * x, x * y * y, x * z * z,
                            x * x * y, y * y * y, y * z * z, x * x * z, y * y * z, z * z * z};
  const double by[20][3] = {{0, 0, 0},         {1, 0, 0},         {0, 1, 0},         {0, 0, 1},
                            {y, x, 0},         {z, 0, x},         {0, z, y},         {2 * x, 0, 0},
                            {0, 2 * y, 0},     {0, 0, 2 * z},     {y * z, x * z, x * y}, {3 * x * x, 0, 0},
                            {y * y, 2 * x * y, 0}, {z * z, 0, 2 * x * z}, {2 * x * y, x * x, 0}, {0, 3 * y * y, 0},
                            {0, z * z, 2 * y * z}, {2 * x * z, 0, x * x}, {0, 2 * y * z, y * y}, {0, 0, 3 * z * z}};
  for (int i = 0; i < 20; ++i) {
    m[i] = value[i];
    for (int k = 0; k < 3; ++k) d[i][k] = by[i][k];
  }
}

// (col, row) of an RPC and their derivatives by ECEF, at ECEF.
void Project(const View& view, const double y[3], double image[2], double by[2][3]) {
  const double flat = std::hypot(y[0], y[1]), lon = std::atan2(y[1], y[0]);
  double lat = std::atan2(y[2], flat * (1.0 - kE2)), normal = kA, alt = 0.0;
  for (int n = 0; n < 4; ++n) {
    const double s = std::sin(lat);
    normal = kA / std::sqrt(1.0 - kE2 * s * s);
    alt = flat / std::cos(lat) - normal;
    lat = std::atan2(y[2], flat * (1.0 - kE2 * normal / (normal + alt)));
  }
  const double sl = std::sin(lon), cl = std::cos(lon), sp = std::sin(lat), cp = std::cos(lat);
  const double meridian = normal * (1.0 - kE2) / (1.0 - kE2 * sp * sp);
  const double along = 1.0 / (kDegree * (normal + alt) * cp), up = 1.0 / (kDegree * (meridian + alt));
  const double ground[3] = {lon / kDegree, lat / kDegree, alt};
  const double jacobian[3][3] = {
      {-sl * along, cl * along, 0.0}, {-sp * cl * up, -sp * sl * up, cp * up}, {cp * cl, cp * sl, sp}};
  double g[3], m[20], d[20][3];
  for (int k = 0; k < 3; ++k) g[k] = (ground[k] - view.offset[k]) / view.scale[k];
  Monomials(g, m, d);
  for (int c = 0; c < 2; ++c) {
    double p[2] = {0, 0}, dp[2][3] = {{0, 0, 0}, {0, 0, 0}};
    for (int h = 0; h < 2; ++h) {
      const double* a = view.coeffs[2 * c + h];
      for (int i = 0; i < 20; ++i) {
        p[h] += a[i] * m[i];
        for (int k = 0; k < 3; ++k) dp[h][k] += a[i] * d[i][k];
      }
    }
    const double q = p[0] / p[1];
    image[c] = q * view.scale[3 + c] + view.offset[3 + c];
    double of_ground[3];
    for (int k = 0; k < 3; ++k)
      of_ground[k] = (dp[0][k] - q * dp[1][k]) / p[1] * view.scale[3 + c] / view.scale[k];
    for (int k = 0; k < 3; ++k) {
      by[c][k] = 0.0;
      for (int l = 0; l < 3; ++l) by[c][k] += of_ground[l] * jacobian[l][k];
    }
  }
}

class Tie : public ceres::SizedCostFunction<2, 6, 3> {
 public:
  Tie(const View& view, const Seen& seen) : view_(view), seen_(seen) {}
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const double *p = parameters[0], *x = parameters[1];
    double w[3], v[3], r[3][3], image[2], by[2][3], y[3];
    for (int k = 0; k < 3; ++k) {
      w[k] = p[k] / view_.reach;
      v[k] = x[k] - p[3 + k] - view_.center[k];
    }
    const double t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], t = std::sqrt(t2);
    const double a = t > 1e-6 ? std::sin(t) / t : 1.0 - t2 / 6.0;
    const double b = t > 1e-6 ? (1.0 - std::cos(t)) / t2 : 0.5 - t2 / 24.0;
    const double k[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    double right[3][3];  // of the right Jacobian: 1 - b K + ...; angles are microradians
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        double kk = 0.0;
        for (int l = 0; l < 3; ++l) kk += k[i][l] * k[l][j];
        r[i][j] = (i == j) + a * k[i][j] + b * kk;
        right[i][j] = (i == j) - b * k[i][j] + kk / 6.0;
      }
    for (int i = 0; i < 3; ++i) y[i] = r[i][0] * v[0] + r[i][1] * v[1] + r[i][2] * v[2] + view_.center[i];
    Project(view_, y, image, by);
    residuals[0] = (image[0] - seen_.col) / seen_.sigma;
    residuals[1] = (image[1] - seen_.row) / seen_.sigma;
    if (jacobians == nullptr) return true;
    const double cross[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    for (int c = 0; c < 2; ++c) {
      double turned[3], crossed[3];  // by X, and by a turn
      for (int j = 0; j < 3; ++j)
        turned[j] = (by[c][0] * r[0][j] + by[c][1] * r[1][j] + by[c][2] * r[2][j]) / seen_.sigma;
      for (int j = 0; j < 3; ++j)
        crossed[j] = -(turned[0] * cross[0][j] + turned[1] * cross[1][j] + turned[2] * cross[2][j]);
      if (jacobians[0] != nullptr)
        for (int j = 0; j < 3; ++j) {
          jacobians[0][6 * c + j] =
              (crossed[0] * right[0][j] + crossed[1] * right[1][j] + crossed[2] * right[2][j]) / view_.reach;
          jacobians[0][6 * c + 3 + j] = -turned[j];
        }
      if (jacobians[1] != nullptr)
        for (int j = 0; j < 3; ++j) jacobians[1][3 * c + j] = turned[j];
    }
    return true;
  }

 private:
  const View& view_;
  const Seen& seen_;
};

class Prior : public ceres::SizedCostFunction<6, 6> {
 public:
  explicit Prior(const View& view) : view_(view) {}
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    for (int k = 0; k < 6; ++k) residuals[k] = parameters[0][k] / view_.sigma[k];
    if (jacobians != nullptr && jacobians[0] != nullptr)
      for (int k = 0; k < 36; ++k) jacobians[0][k] = k % 7 == 0 ? 1.0 / view_.sigma[k / 7] : 0.0;
    return true;
  }

 private:
  const View& view_;
};

template <typename T>
void Read(FILE* file, std::vector<T>* into, size_t count) {
  into->resize(count);
  if (std::fread(into->data(), sizeof(T), count, file) != count) std::abort();
}

}  // namespace

int main(int argc, char** argv) {
  FILE* file = std::fopen(argv[1], "rb");
  if (argc != 3 || file == nullptr) return 2;
  std::vector<int64_t> counts;
  std::vector<View> views;
  std::vector<Seen> seen;
  std::vector<double> first;
  Read(file, &counts, 3);
  Read(file, &views, counts[0]);
  Read(file, &seen, counts[1]);
  Read(file, &first, 3 * counts[2]);
  std::fclose(file);
  const std::string how = argv[2];
  const clock_t start = std::clock();
  std::vector<double> cameras(6 * views.size(), 0.0), points = first;
  ceres::Problem problem;
  ceres::Solver::Options options;
  auto* ordering = new ceres::ParameterBlockOrdering;
  for (const Seen& one : seen)
    problem.AddResidualBlock(
        new Tie(views[one.view], one), nullptr, &cameras[6 * one.view], &points[3 * one.point]);
  for (size_t v = 0; v < views.size(); ++v) {
    problem.AddResidualBlock(new Prior(views[v]), nullptr, &cameras[6 * v]);
    ordering->AddElementToGroup(&cameras[6 * v], 1);
  }
  for (size_t p = 0; 3 * p < points.size(); ++p)
    if (problem.HasParameterBlock(&points[3 * p])) ordering->AddElementToGroup(&points[3 * p], 0);
  options.linear_solver_ordering.reset(ordering);
  options.linear_solver_type = how == "dense"    ? ceres::DENSE_SCHUR
                               : how == "sparse" ? ceres::SPARSE_SCHUR
                                                 : ceres::ITERATIVE_SCHUR;
  options.preconditioner_type = ceres::SCHUR_JACOBI;
  options.num_threads = 1;
  options.initial_trust_region_radius = 1e8;  // Gauss-Newton's steps: what is begun with is near
  options.max_num_iterations = 100;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  const double seconds = double(std::clock() - start) / CLOCKS_PER_SEC;
  rusage used;
  getrusage(RUSAGE_SELF, &used);
  std::printf("%.4f %.12g %d %.0f\n", seconds, 2.0 * summary.final_cost, int(summary.iterations.size()) - 1,
              used.ru_maxrss / 1e3);
}
