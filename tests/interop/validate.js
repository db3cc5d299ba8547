// Fails if Khronos' validator finds an error in a glTF file: node validate.js FOLDER_OF_GLTF_VALIDATOR FILE
const [validator, file] = process.argv.slice(2);
const bytes = new Uint8Array(require("fs").readFileSync(file));
require(validator).validateBytes(bytes).then(({ issues, info }) => {
    // The validator does not know the extension's attributes yet.
    const isOfExtension = ({ pointer, message }) => pointer.includes("KHR_gaussian_splatting:") && message.startsWith("Invalid attribute name");
    const errors = issues.messages.filter((message) => message.severity === 0 && !isOfExtension(message));
    errors.slice(0, 5).forEach((message) => console.error(`${file}: ${message.pointer}: ${message.message}`));
    console.log(`${file}: ${errors.length} errors, ${issues.numWarnings} warnings, glTF ${info.version}`);
    process.exit(errors.length > 0 ? 1 : 0);
});
