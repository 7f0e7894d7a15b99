// Acts by an ONNX model of `quad_rl.export_onnx`, here of 11 observations and 3 actions, with ten candidates and five steps of noise.
#include <onnxruntime_cxx_api.h>
#include <random>

Ort::Env env;
Ort::Session session{env, "policy.onnx", Ort::SessionOptions{}};
std::mt19937_64 generator{std::random_device{}()};

std::vector<float> act(std::vector<float> observation) {
  int64_t rows[] = {1, 11}, drawn[] = {1, 5, 10, 3};  // the shapes above
  std::vector<float> noise(5 * 10 * 3);
  for (float& x : noise) x = std::normal_distribution<float>{}(generator);
  auto cpu = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  Ort::Value inputs[] = {Ort::Value::CreateTensor(cpu, observation.data(), observation.size(), rows, 2),
                         Ort::Value::CreateTensor(cpu, noise.data(), noise.size(), drawn, 4)};
  const char *given[] = {"observations", "noise"}, *wanted[] = {"actions"};
  auto out = session.Run(Ort::RunOptions{}, given, inputs, 2, wanted, 1);
  const float* action = out[0].GetTensorData<float>();
  return {action, action + 3};
}
