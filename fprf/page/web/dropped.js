// Files that are dropped or chosen before a scene is open, with their names below the folder that was given.

/** A file and its name. @typedef {{name: string, file: File}} NamedFile */

/** @param {FileSystemFileEntry} entry @returns {Promise<File>} */
const fileOf = (entry) => new Promise((done, failed) => { entry.file(done, failed); });

/** Some of a folder, none at its end. @param {FileSystemDirectoryReader} reader @returns {Promise<FileSystemEntry[]>} */
const someOf = (reader) => new Promise((done, failed) => { reader.readEntries(done, failed); });

/** All files within. @param {FileSystemEntry} entry @param {string} folder @returns {Promise<NamedFile[]>} */
const within = async (entry, folder) => {
  if (entry instanceof FileSystemFileEntry) return [{ name: folder + entry.name, file: await fileOf(entry) }];
  if (!(entry instanceof FileSystemDirectoryEntry)) return [];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await someOf(reader);
    if (!some.length) return found;
    for (const each of some) found.push(...await within(each, `${folder}${entry.name}/`));
  }
};

/** What was dropped. @param {DataTransfer} data @returns {Promise<NamedFile[]>} */
const carried = async (data) => {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry !== null && entry !== undefined);
  if (!entries.length) return [...data.files].map((file) => ({ name: file.name, file }));
  return (await Promise.all(entries.map((entry) => within(entry, "")))).flat();
};

/** What was chosen. @param {FileList?} files @returns {NamedFile[]} */
const chosen = (files) => [...(files ?? [])].map((file) => ({ name: file.webkitRelativePath || file.name, file }));

/** Without hidden files, and without the folder that all lie in, which is `top`. @param {NamedFile[]} rows */
const tidy = (rows) => {
  const seen = rows.filter(({ name }) => !name.split("/").some((part) => part.startsWith(".")));
  const [top] = (seen[0]?.name ?? "").split("/", 1);
  if (!seen.every(({ name }) => name.startsWith(`${top}/`))) return { rows: seen, top: "" };
  return { rows: seen.map(({ name, file }) => ({ name: name.slice(top.length + 1), file })), top };
};
